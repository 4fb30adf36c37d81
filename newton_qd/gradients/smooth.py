"""Descriptors that have a gradient, for environments that exist already."""

from __future__ import annotations

import copy
from typing import Any

from newton_qd import checks
from newton_qd.envs.base import Env
from newton_qd.wrappers import FeetContactWrapper
from newton_qd.wrappers.base import Wrapper


def with_smooth_descriptor(
    env: Env, width: float = 0.02, straight_through: bool = False
) -> Any:
    """Returns the environment with a state descriptor that has a gradient.

    Feet contact becomes its smooth reading, and with it the feet-contact proportion of
    an episode; the position of the torso is smooth as it is, and so are tasks that
    it describes. This is ``create(..., qdax_wrappers_kwargs=[{"smooth_width": width,
    "straight_through": straight_through}])`` for an environment that is already made.

    Args:
        env: The environment; it stays as it is.
        width: Share of the robot's weight over which the reading of a foot rises [-],
            above 0.
        straight_through: Whether the reading stays 0 or 1, and the gradient alone is
            that of the smooth reading.

    Raises:
        TypeError: ``env`` is no environment, ``width`` no number or
            ``straight_through`` neither true nor false.
        ValueError: ``width`` is not finite and above 0.
    """
    checks.environment(env)
    checks.number("width", width, above=0)
    checks.flag("straight_through", straight_through)
    if not isinstance(env, Wrapper):
        return env
    if isinstance(env, FeetContactWrapper):
        return FeetContactWrapper(env.env, env.name, width, straight_through)
    changed = copy.copy(env)
    changed.env = with_smooth_descriptor(env.env, width, straight_through)
    return changed
