"""Descriptors and ends of episodes with a gradient, for existing environments."""

from __future__ import annotations

import copy

from newton_qd import checks
from newton_qd.envs.base import Env, PhysicsEnv
from newton_qd.envs.limits import check_width
from newton_qd.physics.system import TAILS
from newton_qd.wrappers import FeetContactWrapper
from newton_qd.wrappers.base import Wrapper


def with_smooth_descriptor(
    env: Env,
    width: float = 0.02,
    straight_through: bool = False,
    tail: str = "exponential",
) -> Env:
    """Returns the environment with a state descriptor that has a gradient.

    Feet contact becomes smooth, and so does the feet-contact proportion of an episode.
    The position of the torso is already smooth, so tasks with this descriptor do not
    change. For an existing environment, this is the same as ``create(...,
    qdax_wrappers_kwargs=[{"smooth_width": width, "straight_through":
    straight_through, "smooth_tail": tail}])``.

    Args:
        env: The environment; it does not change.
        width: Share of the robot's weight over which the contact of a foot rises from 0
            to 1 [-], above 0.
        straight_through: Whether the contact stays 0 or 1, but has the gradient of the
            smooth contact.
        tail: How the slope of the smooth contact decays for large loads:
            ``"exponential"``, or ``"algebraic"``, which has a useful gradient for a
            foot that stands.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: ``width`` is not finite and above 0, or ``tail`` is not allowed.
    """
    checks.environment(env)
    checks.number("width", width, above=0)
    checks.flag("straight_through", straight_through)
    checks.choice("tail", tail, TAILS)
    if not isinstance(env, Wrapper):
        return env
    if isinstance(env, FeetContactWrapper):
        return env.smoothed(width, straight_through, tail)
    changed = copy.copy(env)
    changed.env = with_smooth_descriptor(env.env, width, straight_through, tail)
    return changed


def with_smooth_termination(env: Env, width: float) -> Env:
    """Returns the environment with a ``done`` that has a gradient.

    Values stay the same: ``done`` is 0 or 1. Its gradient is that of a smooth step, in
    the environments that end an episode when height or pitch leave their limits. So
    the gradient of an :class:`~newton_qd.gradients.Episode` sees that a fall is near,
    and a learning method sees it from ``1 - done``. In other environments, this changes
    nothing. A robot of your own computes its limits with
    ``newton_qd.envs.limits.within``.

    Args:
        env: The environment; it does not change.
        width: Width of the smooth step, a logistic function [m or rad]. The slope of
            ``done`` at a limit is 1/(4 width).

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: ``width`` is not finite or below 1e-6.
    """
    checks.environment(env)
    check_width("width", width)

    def change(base: Env) -> Env:
        changed = copy.copy(base)
        if isinstance(changed, PhysicsEnv):
            changed.termination_width = float(width)
        return changed

    return env.with_base(change) if isinstance(env, Env) else env
