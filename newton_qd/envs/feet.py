"""Feet contact: two readings of the normal impulse on each foot."""

from __future__ import annotations

import jax
import numpy as np

from newton_qd.physics.system import PhysicsState, System

CONTACT_FRACTION = 0.01
"""Share of the robot's weight above which a foot touches the ground [-]."""


def load_fraction(system: System, state: PhysicsState) -> jax.Array:
    """Share of the robot's weight that each foot carried over the control step.

    Args:
        system: The system.
        state: State after the control step; zero after a reset.

    Returns:
        (nf,) normal impulse over (mass x gravity x dt) [-].
    """
    robot = system.robot
    weight = system.total_mass * robot.gravity * robot.dt
    feet = system.feet.astype(np.int32)
    return state.normal_impulse[feet] / np.asarray(weight, system.dtype)


def feet_contact(system: System, state: PhysicsState) -> jax.Array:
    """Which feet touched the ground; the gradient is zero.

    Args:
        system: The system.
        state: State after the control step.

    Returns:
        (nf,) 1 where a foot carried more than 1 % of the weight, else 0.
    """
    touching = load_fraction(system, state) > CONTACT_FRACTION
    return touching.astype(system.dtype)


def smooth_feet_contact(
    system: System, state: PhysicsState, width: float, straight_through: bool = False
) -> jax.Array:
    """How firmly each foot touched the ground; useful for gradients.

    Args:
        system: The system.
        state: State after the control step.
        width: Share of the weight over which the reading rises [-], above 0; as it
            goes to 0 the reading goes to that of :func:`feet_contact`.
        straight_through: Whether the value is that of :func:`feet_contact`, and the
            gradient alone is smooth (Bengio et al. 2013, "Estimating or propagating
            gradients through stochastic neurons").

    Returns:
        (nf,) between 0 and 1; 0.5 where :func:`feet_contact` switches.
    """
    if not width > 0:
        raise ValueError(f"width={width!r}: allowed: above 0")
    smooth = jax.nn.sigmoid((load_fraction(system, state) - CONTACT_FRACTION) / width)
    if not straight_through:
        return smooth
    # the difference is exactly 0
    return feet_contact(system, state) + (smooth - jax.lax.stop_gradient(smooth))
