"""One control step as a pure JAX function."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.physics import bridge
from newton_qd.physics.inspection import checked_vector, forward_kinematics
from newton_qd.physics.kinds import JointKind
from newton_qd.physics.parameters import PARAMS, PhysicsParams, parameter_row
from newton_qd.physics.system import (
    CONTACT_FRACTION,
    PhysicsState,
    System,
    require_physics_state,
    takes_system,
)

_ROUNDED = 1e-3
"""Largest difference from 1 of the squared length of a quaternion that is kept."""


@takes_system
def initial_state(system: System, q: jax.Array, v: jax.Array) -> PhysicsState:
    """Returns the state before the first step, with zero contact impulses.

    Args:
        system: The system.
        q: (nq,) coordinates [m or rad]. Quaternions may have any length above 0.
        v: (nv,) velocities [m/s or rad/s].

    Returns:
        The state.

    Raises:
        ValueError: ``q`` or ``v`` has the wrong shape, or the system is float64 and
            JAX x64 is off.
    """
    dtype = jnp.dtype(system.dtype)
    q = unit_quaternions(system, checked_vector(system, "q", q, system.nq))
    v = checked_vector(system, "v", v, system.nv)
    bodies = forward_kinematics(system, q, v) if system.reports_bodies else None
    start = int(system.q_start[system.torso])
    torso_xy = q[start : start + 2]
    if not system.torso_floats:
        seen = bodies or forward_kinematics(system, q, v)
        torso_xy = seen.position[system.torso, :2]
    feet = system.feet.shape
    return PhysicsState(
        q=q,
        v=v,
        impulse=jnp.zeros((system.nb, 6), dtype),
        normal_impulse=jnp.zeros((system.nb,), dtype),
        feet_contact=jnp.zeros(feet, dtype),
        smooth_feet_contact=jnp.full(feet, _unloaded(system), dtype),
        torso_xy=torso_xy,
        bodies=bodies,
    )


@takes_system
def unit_quaternions(system: System, q: jax.Array) -> jax.Array:
    """Returns coordinates whose quaternions have the length 1.

    One whose length differs from 1 by less than about 0.0005 stays bitwise the same.
    One of length 0 is no rotation: it becomes NaN, which a step reports as a fault.

    Args:
        system: The system.
        q: (nq,) coordinates [m or rad].

    Raises:
        TypeError: ``q`` is not an array, or has the wrong dtype.
        ValueError: ``q`` has the wrong shape, or the system is float64 and JAX x64 is
            off.
    """
    checks.x64(np.dtype(system.dtype))
    q = checks.array("q", q, (system.nq,), system.dtype)
    for start in system.q_start[system.joint_kind == JointKind.FREE] + 3:
        quaternion = q[start : start + 4]
        # the square of a long one would overflow, and that of a short one vanish
        largest = jax.lax.stop_gradient(jnp.max(jnp.abs(quaternion)))
        some = largest > 0
        shrunk = quaternion / jnp.where(some, largest, 1)
        length = jnp.sqrt(jnp.where(some, jnp.sum(shrunk**2), 1))
        scaled = jnp.where(some, shrunk / length, jnp.nan)
        near = jnp.abs(jnp.sum(quaternion**2) - 1) <= _ROUNDED
        unit = jnp.where(near, quaternion, scaled)
        q = q.at[start : start + 4].set(unit)
    return q


def _unloaded(system: System) -> float:
    """Returns the smooth contact of a foot without load."""
    deficit = CONTACT_FRACTION / system.feet_width
    if system.feet_tail == "algebraic":
        return 0.5 - 0.5 * deficit / (1.0 + np.hypot(1.0, deficit))
    # 1 / (1 + exp(.)), in a form that does not overflow
    return np.exp(-np.logaddexp(0.0, deficit))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Foreseen:
    """The result of a step that is known already, in place of its parameters.

    :func:`rollout` computes the steps of a plan at once. Environments then take their
    rewards and observations from the same code as in a single step.

    Attributes:
        after: State after the step.
        fault: () fault of the step.
    """

    after: PhysicsState
    fault: jax.Array


@takes_system
def step(
    system: System,
    state: PhysicsState,
    control: jax.Array,
    params: PhysicsParams | None = None,
) -> tuple[PhysicsState, jax.Array]:
    """Advances one world by one control step.

    Args:
        system: The system.
        state: State of the world.
        control: (nu,) actions [-]. They are scaled by the gear and not clipped.
        params: Physical parameters of the world. ``None``: the parameters of the
            system, with kernels that do not read parameters.

    Returns:
        The next state, and the fault () int32. The fault is 1 if a value was not
        finite or a velocity exceeded 1,000 [m/s or rad/s], else 0. After a fault
        ``q`` and ``v`` are those of ``state``, or the default pose at rest if those
        are not finite. The impulses are zero, and every gradient through the step is
        exactly zero.

    Raises:
        TypeError: The type of the state, the control or a parameter is not that of
            the system.
        ValueError: The state, the control or a parameter has the wrong shape; a
            concrete parameter is out of bounds; the value of an environment variable
            is not allowed; or the system is float64 and JAX x64 is off.
    """
    require_physics_state(state)
    own = None if params is None else parameter_row(system, params)
    run = bridge.control_step(system)
    after, fault = run(state.q, state.v, control, own)
    return after, fault.astype(jnp.int32)


def step_or_known(
    system: System,
    state: PhysicsState,
    control: jax.Array,
    params: PhysicsParams | Foreseen | None,
) -> tuple[PhysicsState, jax.Array]:
    """Returns what :func:`step` returns, or what is known of this step.

    Args:
        system: The system.
        state: State of the world.
        control: (nu,) actions [-].
        params: Parameters as in :func:`step`, or the result of this one step.

    Raises:
        TypeError: As :func:`step`.
        ValueError: As :func:`step`. Or the result is that of several steps.
    """
    if not isinstance(params, Foreseen):
        return step(system, state, control, params)
    if jnp.shape(params.fault) != ():
        given = Fact(f"the result of a rollout of {len(params.fault)} steps")
        raise ValueError(message("params", given, PARAMS))
    return params.after, params.fault


@takes_system
def rollout(
    system: System,
    state: PhysicsState,
    controls: jax.Array,
    params: PhysicsParams | None = None,
) -> Foreseen:
    """Advances one world by a plan of controls.

    The results equal those of :func:`step` in ``jax.lax.scan``, bit by bit. On a CPU
    all steps are one call, and so is their gradient, which stores one state for each
    control step and computes the rest again.

    Args:
        system: The system.
        state: State of the world before the first step.
        controls: (T, nu) actions of each step [-]. They are scaled by the gear and not
            clipped.
        params: Physical parameters of the world, as in :func:`step`.

    Returns:
        ``after``, the states after each step, and ``fault``, their faults, leaves
        (T, ...). After a fault a world keeps its state, and each later step has a fault
        too.

    Raises:
        TypeError: The type of the state, a control or a parameter is not that of the
            system.
        ValueError: The state, the controls or a parameter has the wrong shape; a
            concrete parameter is out of bounds; the value of an environment variable
            is not allowed; or the system is float64 and JAX x64 is off.
    """
    require_physics_state(state)
    own = None if params is None else parameter_row(system, params)
    after, fault = bridge.rollout(system, state.q, state.v, controls, own)
    return Foreseen(after, fault.astype(jnp.int32))
