"""The environment that an adapter stands on: one world, or a batch of worlds."""

from __future__ import annotations

from typing import Any

from newton_qd import registry
from newton_qd.checks import Fact, message
from newton_qd.envs.base import Env
from newton_qd.wrappers.one_world import require_one_world


def one_world(env: str | Env, options: dict[str, Any], *, endless: bool = False) -> Env:
    """Returns an environment of one world that does not reset itself.

    Args:
        env: Name of an environment, or an environment.
        options: Arguments of ``newton_qd.create`` for a name.
        endless: Whether an environment with an episode length is refused.

    Raises:
        TypeError: ``env`` is neither, or an option is unknown.
        ValueError: An environment has options, a batch, auto-reset, or an episode
            length that is refused.
        UnknownEnvironment: The name is not registered.
    """
    if isinstance(env, str):
        if "auto_reset" in options:
            why = "which the adapter decides"
            allowed = "other arguments of newton_qd.create"
            raise TypeError(message("options", "auto_reset", allowed, why=why))
        env = registry.create(env, auto_reset=False, **options)
    elif not isinstance(env, Env):
        allowed = "a name of newton_qd.registered_envs(), or an environment"
        raise TypeError(message("env", env, allowed))
    elif options:
        given = Fact(f"an environment with options {', '.join(sorted(options))}")
        raise ValueError(message("env", given, "a name with options"))
    require_one_world(env, endless=endless)
    return env
