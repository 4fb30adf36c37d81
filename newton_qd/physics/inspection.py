"""Functions that inspect a state: kinematics, contacts, mass matrix, bias forces."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.physics import bridge
from newton_qd.physics.model.rest import grounding_coordinate, own_ground_contacts
from newton_qd.physics.system import (
    Kinematics,
    PhysicsState,
    System,
    require_physics_state,
    takes_system,
)
from newton_qd.real_numbers import require_real


def _rotate(quaternion: jax.Array, vector: jax.Array) -> jax.Array:
    """Rotate vectors (..., 3) by quaternions xyzw (..., 4)."""
    axis, w = quaternion[..., :3], quaternion[..., 3:]
    turned = 2.0 * jnp.cross(axis, vector)
    return vector + w * turned + jnp.cross(axis, turned)


def checked_vector(system: System, name: str, value: jax.Array, size: int) -> jax.Array:
    """Returns a vector (size,) in the dtype of a system.

    Raises:
        TypeError: It does not have real numbers.
        ValueError: It has the wrong shape, or the system is float64 and JAX x64 is off.
    """
    checks.x64(np.dtype(system.dtype))
    allowed = f"an array of shape ({size},)"
    checks.instance(name, value, (jax.Array, np.ndarray, list, tuple), allowed)
    require_real(name, jnp.asarray(value))
    value = jnp.asarray(value, jnp.dtype(system.dtype))
    if value.shape != (size,):
        raise ValueError(message(name, value, allowed))
    return value


@takes_system
def forward_kinematics(system: System, q: jax.Array, v: jax.Array) -> Kinematics:
    """Computes the pose and the velocity of every body.

    Args:
        system: The system.
        q: (nq,) coordinates [m or rad].
        v: (nv,) velocities [m/s or rad/s].

    Returns:
        The kinematics. Differentiable in reverse mode.

    Raises:
        TypeError: ``q`` or ``v`` does not have real numbers.
        ValueError: ``q`` or ``v`` has the wrong shape, or the system is float64 and
            JAX x64 is off.
    """
    q = checked_vector(system, "q", q, system.nq)
    v = checked_vector(system, "v", v, system.nv)
    return bridge.kinematics(system)(q, v)


@takes_system
def seen_bodies(system: System, state: PhysicsState) -> Kinematics:
    """Returns the pose and the velocity of every body.

    If the step reported them, they come from the state. Otherwise they are computed.

    Args:
        system: The system.
        state: State of one world.

    Returns:
        The kinematics. Differentiable in reverse mode.

    Raises:
        TypeError: ``state`` is not a ``PhysicsState``.
        ValueError: ``q`` or ``v`` of the state has the wrong shape, or the system is
            float64 and JAX x64 is off.
    """
    require_physics_state(state)
    if state.bodies is not None:
        return state.bodies
    return forward_kinematics(system, state.q, state.v)


@takes_system
def mass_matrix(system: System, q: jax.Array) -> jax.Array:
    """Computes the joint-space inertia, including the armature.

    The result is not differentiable.

    Args:
        system: The system.
        q: (nq,) coordinates [m or rad].

    Returns:
        (nv, nv) symmetric matrix M in the equation M dv/dt + bias = force.

    Raises:
        TypeError: ``q`` does not have real numbers.
        ValueError: ``q`` has the wrong shape, or the system is float64 and JAX x64 is
            off.
    """
    q = checked_vector(system, "q", q, system.nq)
    return bridge.dynamics(system, q, jnp.zeros((system.nv,), q.dtype))[0]


@takes_system
def bias_forces(system: System, q: jax.Array, v: jax.Array) -> jax.Array:
    """Computes the bias forces: velocity-product forces and gravity.

    Damping, springs and contacts are not included. The result is not differentiable.

    Args:
        system: The system.
        q: (nq,) coordinates [m or rad].
        v: (nv,) velocities [m/s or rad/s].

    Returns:
        (nv,) generalized force [N or N m] that makes dv/dt zero.

    Raises:
        TypeError: ``q`` or ``v`` does not have real numbers.
        ValueError: ``q`` or ``v`` has the wrong shape, or the system is float64 and
            JAX x64 is off.
    """
    q = checked_vector(system, "q", q, system.nq)
    v = checked_vector(system, "v", v, system.nv)
    return bridge.dynamics(system, q, v)[1]


@takes_system
def contact_gaps(system: System, q: jax.Array) -> jax.Array:
    """Computes the gaps of all contacts, with the distances that the step uses.

    The result is not differentiable.

    Args:
        system: The system.
        q: (nq,) coordinates [m or rad].

    Returns:
        (nc,) gap for each row of the system's contact tables [m]. A negative gap is a
        penetration. Both rows of a pair have the same gap.

    Raises:
        TypeError: ``q`` does not have real numbers.
        ValueError: ``q`` has the wrong shape, or the system is float64 and JAX x64 is
            off.
    """
    q = checked_vector(system, "q", q, system.nq)
    if not len(system.contact_body):
        return jnp.zeros((0,), q.dtype)
    return bridge.contact_gaps(system, q)


@takes_system
def contact_impulses(
    system: System, state: PhysicsState, control: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Computes the impulse of each contact in every substep of a control step.

    A step reports the sums for each body. The result is not differentiable.

    Args:
        system: The system.
        state: State of one world at the start of the step.
        control: (nu,) actions [-].

    Returns:
        (substeps, nc, 3) impulse on the body of each row of the system's contact
        tables, with friction, in world axes [N s]; and (substeps, nc) its normal part
        [N s], never negative.

    Raises:
        TypeError: ``state`` is not a ``PhysicsState``.
        ValueError: The state or the control has the wrong shape, or the system is
            float64 and JAX x64 is off.
    """
    require_physics_state(state)
    q = checked_vector(system, "q", state.q, system.nq)
    v = checked_vector(system, "v", state.v, system.nv)
    control = checked_vector(system, "control", control, system.nu)
    if not len(system.contact_body):
        empty = jnp.zeros((system.substeps, 0, 4), q.dtype)
        return empty[..., :3], empty[..., 3]
    found = bridge.contact_impulses(system, q, v, control)
    return found[..., :3], found[..., 3]


@takes_system
def lowest_contact(system: System, q: jax.Array) -> jax.Array:
    """Computes the height of the lowest point of all ground-contact spheres [m].

    Args:
        system: The system.
        q: (nq,) coordinates [m or rad].

    Returns:
        () height above z = 0 [m].

    Raises:
        TypeError: ``q`` does not have real numbers.
        ValueError: ``q`` has the wrong shape, the robot has no ground contacts, or the
            system is float64 and JAX x64 is off.
    """
    q = checked_vector(system, "q", q, system.nq)
    return _lowest(system, q, system.ground_contacts)


@takes_system
def on_ground(system: System, q: jax.Array) -> jax.Array:
    """Moves the torso, and what hangs on it, up or down to the ground.

    Args:
        system: The system.
        q: (nq,) coordinates [m or rad].

    Returns:
        (nq,) coordinates; ``q`` if the robot has no coordinate that does this (see
        ``grounding_coordinate``).

    Raises:
        TypeError: ``q`` does not have real numbers.
        ValueError: ``q`` has the wrong shape, or the system is float64 and JAX x64 is
            off.
    """
    q = checked_vector(system, "q", q, system.nq)
    grounding = grounding_coordinate(system)
    if grounding is None:
        return q
    coordinate, sign = grounding
    lowest = _lowest(system, q, own_ground_contacts(system))
    return q.at[coordinate].add(-sign * lowest)


def _lowest(system: System, q: jax.Array, ground: np.ndarray) -> jax.Array:
    """Returns the height () of the lowest of some contacts [m]."""
    still = jnp.zeros((system.nv,), q.dtype)
    kinematics = forward_kinematics(system, q, still)
    bodies = system.contact_body[ground]
    local = jnp.asarray(system.contact_position[ground], q.dtype)
    centre = kinematics.position[bodies] + _rotate(kinematics.rotation[bodies], local)
    return jnp.min(centre[:, 2] - jnp.asarray(system.contact_radius[ground], q.dtype))
