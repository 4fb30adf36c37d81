"""Whether an environment is one world that does not reset itself."""

from __future__ import annotations

from newton_qd.checks import Fact, message
from newton_qd.envs.base import Env
from newton_qd.wrappers.auto_reset import AutoResetWrapper
from newton_qd.wrappers.base import Wrapper, outermost
from newton_qd.wrappers.episode import EpisodeWrapper
from newton_qd.wrappers.vector import VectorWrapper


def require_one_world(env: Env, *, endless: bool = False) -> None:
    """Checks that an environment is one world that does not reset itself.

    Args:
        env: The environment.
        endless: Whether an episode length is refused, too.

    Raises:
        ValueError: It has a batch, auto-reset, or an episode length that is refused.
    """
    refused: dict[type[Wrapper], str] = {
        AutoResetWrapper: "auto-reset",
        VectorWrapper: "a batch",
    }
    allowed = "one world: create(..., auto_reset=False), no batch_size"
    if endless:
        refused[EpisodeWrapper] = "an episode length"
        allowed += ", episode_length=None"
    for kind, what in refused.items():
        if outermost(env, kind) is not None:
            given = Fact(f"an environment with {what}")
            raise ValueError(message("env", given, allowed))
