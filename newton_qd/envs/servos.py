"""Actions that are target angles."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd.envs.vectors import rounded
from newton_qd.physics.system import System
from newton_qd.types import Action


def servo_targets(system: System, action: Action) -> jax.Array:
    """Returns target angles: -1 is the lower end of a joint's range, 1 the upper end.

    Args:
        system: A robot whose actuators all hold angles, between limits.
        action: (nu,) the action; beyond -1 and 1 it is clipped.

    Returns:
        (nu,) targets [rad or m].
    """
    dofs = system.control_dof
    low = jnp.asarray(system.limit_lower[dofs], system.dtype)
    high = jnp.asarray(system.limit_upper[dofs], system.dtype)
    return low + rounded((high - low) * (jnp.clip(action, -1, 1) + 1) / 2)
