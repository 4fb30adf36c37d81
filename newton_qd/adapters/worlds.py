"""The environment that an adapter stands on: one world, or a batch of worlds."""

from __future__ import annotations

from typing import Any

from newton_qd import registry
from newton_qd.checks import Fact, message
from newton_qd.envs.base import Env
from newton_qd.wrappers import AutoResetWrapper, VectorWrapper, Wrapper


def one_world(env: str | Env, options: dict[str, Any]) -> Env:
    """Returns an environment of one world that does not reset itself.

    Args:
        env: Name of an environment, or an environment.
        options: Arguments of ``newton_qd.create`` for a name.

    Raises:
        TypeError: ``env`` is neither, or an option is unknown.
        ValueError: An environment has options, a batch or auto-reset.
        UnknownEnvironment: The name is not registered.
    """
    if isinstance(env, str):
        return registry.create(env, auto_reset=False, **options)
    if not isinstance(env, Env):
        allowed = "a name of newton_qd.registered_envs(), or an environment"
        raise TypeError(message("env", env, allowed))
    if options:
        given = Fact(f"an environment with options {', '.join(sorted(options))}")
        raise ValueError(message("env", given, "a name with options"))
    inside = env
    while isinstance(inside, Wrapper):
        for kind, what in (
            (VectorWrapper, "a batch"),
            (AutoResetWrapper, "auto-reset"),
        ):
            if isinstance(inside, kind):
                given = Fact(f"an environment with {what}")
                allowed = "one world: create(..., auto_reset=False), no batch_size"
                raise ValueError(message("env", given, allowed))
        inside = inside.env
    return env
