"""Velocity changes by contact, for observations and costs."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.checks import message
from newton_qd.physics.explicit_mesh import rows_of, split_as
from newton_qd.physics.system import PhysicsState, System


def linear_changes(
    system: System, state: PhysicsState, bodies: np.ndarray
) -> jax.Array:
    """Returns the contact impulse, friction included, divided by the mass.

    Args:
        system: The system.
        state: State after the control step; zero after a reset.
        bodies: (n,) bodies with mass.

    Returns:
        (n, 3) world axes [m/s].
    """
    mass = np.asarray(system.mass[bodies], system.dtype)[:, None]
    return rows_of(state.impulse, bodies, slice(0, 3)) / mass


def angular_changes(
    system: System, state: PhysicsState, bodies: np.ndarray, reader: str
) -> jax.Array:
    """Returns the angular contact impulse divided by the inertia.

    Args:
        system: The system.
        state: State after the control step; zero after a reset.
        bodies: (n,) bodies with mass.
        reader: Name of the caller, used in errors.

    Returns:
        (n, 3) world axes [rad/s].

    Raises:
        ValueError: An inertia is not the same about every axis.
    """
    inertia = isotropic_inertia(system, bodies, reader)
    turned = rows_of(state.impulse, bodies, slice(3, 6))
    return turned / np.asarray(inertia, system.dtype)[:, None]


def padded(changes: jax.Array, still: int) -> jax.Array:
    """Returns the rows of bodies (n, 3), then zeros for obstacles, as one vector."""
    # Ground and walls never move. Their zeros keep the layout that policies expect.
    zeros = split_as([changes], jnp.zeros((still, 3), changes.dtype))
    return jnp.concatenate([changes, zeros]).reshape(-1)


def isotropic_inertia(system: System, bodies: np.ndarray, reader: str) -> np.ndarray:
    """Returns the moment of inertia (n,) of each body, equal about all axes [kg m^2].

    Args:
        system: The system.
        bodies: (n,) bodies with mass.
        reader: Name of the caller, used in errors.

    Raises:
        ValueError: An inertia is not the same about every axis.
    """
    inertia = system.inertia[bodies]
    moment = inertia[:, 0, 0]
    excess = np.abs(inertia - moment[:, None, None] * np.eye(3))
    refused = (excess.max(axis=(1, 2)) > 1e-6 * moment) | (moment <= 0)
    if np.any(refused):
        index = int(np.argmax(refused))
        name = system.body_names[bodies[index]]
        field = f"{reader}: inertia of link {name!r} of {system.robot.urdf!r}"
        allowed = "positive and equal about every axis"
        raise ValueError(message(field, inertia[index].tolist(), allowed))
    return moment
