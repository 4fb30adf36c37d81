"""Points that move with a body."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd.envs.vectors import cross, rotated
from newton_qd.physics.system import Kinematics


def point(
    seen: Kinematics, body: int, offset: tuple[float, float, float]
) -> tuple[jax.Array, jax.Array]:
    """Returns the position and velocity of a point of a body.

    Args:
        seen: Kinematics of one world.
        body: Index of the body.
        offset: The point in the link frame [m].

    Returns:
        Position (3,) [m] and velocity (3,) [m/s], world axes.
    """
    row = slice(body, body + 1)
    local = jnp.asarray([offset], seen.position.dtype)
    position = seen.position[row] + rotated(seen.rotation[row], local)
    arm = position - seen.com[row]
    velocity = seen.linear_velocity[row] + cross(seen.angular_velocity[row], arm)
    return position[0], velocity[0]
