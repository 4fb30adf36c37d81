"""Functions for checking and control: kinematics, gaps, mass matrix, bias forces."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd.checks import message
from newton_qd.physics import bridge
from newton_qd.physics.system import Kinematics, PhysicsState, System


def _rotate(quaternion: jax.Array, vector: jax.Array) -> jax.Array:
    """Rotate (..., 3) vectors by (..., 4) quaternions xyzw."""
    axis, w = quaternion[..., :3], quaternion[..., 3:]
    turned = 2.0 * jnp.cross(axis, vector)
    return vector + w * turned + jnp.cross(axis, turned)


def _checked(system: System, name: str, value: jax.Array, size: int) -> jax.Array:
    value = jnp.asarray(value, jnp.dtype(system.dtype))
    if value.shape != (size,):
        raise ValueError(message(name, value, f"an array of shape ({size},)"))
    return value


def forward_kinematics(system: System, q: jax.Array, v: jax.Array) -> Kinematics:
    """Poses and velocities of every body.

    Args:
        system: The system.
        q: (nq,) coordinates [m or rad].
        v: (nv,) velocities [m/s or rad/s].

    Returns:
        The kinematics; differentiable in reverse mode.

    Raises:
        ValueError: ``q`` or ``v`` has another shape.
    """
    q = _checked(system, "q", q, system.nq)
    v = _checked(system, "v", v, system.nv)
    return bridge.kinematics(system)(q, v)


def seen_bodies(system: System, state: PhysicsState) -> Kinematics:
    """Poses and velocities of every body: as the step reported, or computed now.

    Args:
        system: The system.
        state: State of one world.

    Returns:
        The kinematics; differentiable in reverse mode.

    Raises:
        ValueError: ``q`` or ``v`` of the state has another shape.
    """
    if state.bodies is not None:
        return state.bodies
    return forward_kinematics(system, state.q, state.v)


def mass_matrix(system: System, q: jax.Array) -> jax.Array:
    """Joint-space inertia, armature included.

    Args:
        system: The system.
        q: (nq,) coordinates [m or rad].

    Returns:
        (nv, nv) symmetric matrix M of M dv/dt + bias = force.

    Raises:
        ValueError: ``q`` has another shape.
    """
    q = _checked(system, "q", q, system.nq)
    return bridge.dynamics(system, q, jnp.zeros((system.nv,), q.dtype))[0]


def bias_forces(system: System, q: jax.Array, v: jax.Array) -> jax.Array:
    """Velocity-product and gravity forces, without damping, springs and contacts.

    Args:
        system: The system.
        q: (nq,) coordinates [m or rad].
        v: (nv,) velocities [m/s or rad/s].

    Returns:
        (nv,) generalized force [N or N m] that keeps dv/dt zero.

    Raises:
        ValueError: ``q`` or ``v`` has another shape.
    """
    q = _checked(system, "q", q, system.nq)
    v = _checked(system, "v", v, system.nv)
    return bridge.dynamics(system, q, v)[1]


def contact_gaps(system: System, q: jax.Array) -> jax.Array:
    """Distances of all that can touch, as the step sees them; not differentiable.

    Args:
        system: The system.
        q: (nq,) coordinates [m or rad].

    Returns:
        (nc,) gap of each row of the system's contact tables [m], negative where the two
        are pressed into each other; both rows of a pair have the same.

    Raises:
        ValueError: ``q`` has another shape.
    """
    q = _checked(system, "q", q, system.nq)
    if not len(system.contact_body):
        return jnp.zeros((0,), q.dtype)
    return bridge.contact_gaps(system, q)


def lowest_contact(system: System, q: jax.Array) -> jax.Array:
    """Height of the lowest point of all spheres that touch the ground [m].

    Args:
        system: The system.
        q: (nq,) coordinates [m or rad].

    Returns:
        () height above z = 0 [m].

    Raises:
        ValueError: ``q`` has another shape, or nothing of the robot touches the ground.
    """
    still = jnp.zeros((system.nv,), q.dtype)
    kinematics = forward_kinematics(system, q, still)
    ground = system.ground_contacts
    bodies = system.contact_body[ground]
    local = jnp.asarray(system.contact_position[ground], q.dtype)
    centre = kinematics.position[bodies] + _rotate(kinematics.rotation[bodies], local)
    return jnp.min(centre[:, 2] - jnp.asarray(system.contact_radius[ground], q.dtype))
