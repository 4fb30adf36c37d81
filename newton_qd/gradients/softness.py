"""Soft contacts for gradients, and a series back to stiff contacts."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.envs.base import Env, PhysicsEnv
from newton_qd.robots import Material

_LENGTHS = ("static_penetration", "smoothing", "slip_velocity")
_ANGLES = ("limit_overshoot", "limit_smoothing")


def softened(material: Material, factor: float) -> Material:
    """Returns a material with all scales of softness multiplied by a factor.

    These are the penetration at rest, the widths over which contacts and limits switch
    on, the slip velocity and the overshoot past limits. Friction and dissipation do not
    change.

    Args:
        material: Softness of contacts and joint limits.
        factor: Above 1: softer; gradients stay small over more steps. Below 1: stiffer,
            nearer to rigid bodies.

    Raises:
        TypeError: ``factor`` is not a number, or ``material`` is not a ``Material``.
        ValueError: ``factor`` is not finite and above 0.
    """
    checks.number("factor", factor, above=0)
    checks.instance("material", material, Material, "newton_qd.robots.Material")
    changes = {name: factor * getattr(material, name) for name in _LENGTHS + _ANGLES}
    return dataclasses.replace(material, **changes)


def soft_to_stiff(env: Env, factors: Sequence[float] = (4, 2, 1)) -> tuple[Env, ...]:
    """Returns the environment with several degrees of softness, for a continuation.

    Optimize in the first environment. Start the next one from the result, and so on.
    The last environment is the real one.

    Args:
        env: A simulated robot, with any wrappers; it does not change.
        factors: Factor of the softness of each returned environment.

    Raises:
        TypeError: ``env`` is not an environment, or a factor is not a number.
        ValueError: A factor is not finite and above 0.
        NotImplementedError: The environment inside is not a simulated robot.
    """
    checks.environment(env, needs="unwrapped")
    if not isinstance(factors, Sequence) or isinstance(factors, str):
        raise TypeError(message("factors", factors, "a sequence of numbers above 0"))
    base = env.unwrapped
    if not isinstance(base, PhysicsEnv):
        raise NotImplementedError(
            message(
                "env",
                Fact(env.name),
                "environments whose unwrapped is a PhysicsEnv",
                why="which is not a simulated robot",
            )
        )
    material = base.robot.material
    return tuple(env.with_material(softened(material, factor)) for factor in factors)
