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


def smooth_feet_contact(system: System, state: PhysicsState, width: float) -> jax.Array:
    """How firmly each foot touched the ground; useful for gradients.

    Args:
        system: The system.
        state: State after the control step.
        width: Share of the weight over which the reading rises [-], above 0.

    Returns:
        (nf,) between 0 and 1; 0.5 where :func:`feet_contact` switches.
    """
    if not width > 0:
        raise ValueError(f"width={width!r}: allowed: above 0")
    return jax.nn.sigmoid((load_fraction(system, state) - CONTACT_FRACTION) / width)
