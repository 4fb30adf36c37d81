"""One control step as a pure JAX function."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.physics import bridge
from newton_qd.physics.inspection import forward_kinematics
from newton_qd.physics.parameters import PhysicsParams, parameter_row
from newton_qd.physics.system import CONTACT_FRACTION, PhysicsState, System


def initial_state(system: System, q: jax.Array, v: jax.Array) -> PhysicsState:
    """A state before its first step: nothing has touched the ground yet.

    Args:
        system: The system.
        q: (nq,) coordinates [m or rad].
        v: (nv,) velocities [m/s or rad/s].

    Returns:
        The state.

    Raises:
        ValueError: ``q`` or ``v`` has another shape, where the bodies are computed.
    """
    dtype = jnp.dtype(system.dtype)
    q, v = jnp.asarray(q, dtype), jnp.asarray(v, dtype)
    bodies = forward_kinematics(system, q, v) if system.reports_bodies else None
    start = int(system.q_start[system.torso])
    torso_xy = q[start : start + 2]
    if not system.torso_floats:
        seen = bodies or forward_kinematics(system, q, v)
        torso_xy = seen.position[system.torso, :2]
    feet = system.feet.shape
    # of no load: 1 / (1 + exp(.)), which does not overflow
    unloaded = np.exp(-np.logaddexp(0.0, CONTACT_FRACTION / system.feet_width))
    return PhysicsState(
        q=q,
        v=v,
        impulse=jnp.zeros((system.nb, 6), dtype),
        normal_impulse=jnp.zeros((system.nb,), dtype),
        feet_contact=jnp.zeros(feet, dtype),
        smooth_feet_contact=jnp.full(feet, unloaded, dtype),
        torso_xy=torso_xy,
        bodies=bodies,
    )


def step(
    system: System,
    state: PhysicsState,
    control: jax.Array,
    params: PhysicsParams | None = None,
) -> tuple[PhysicsState, jax.Array]:
    """Advance one world by one control step.

    Args:
        system: The system.
        state: State of the world.
        control: (nu,) actions [-]; scaled by the gear, never clipped.
        params: Physical parameters of the world; ``None``: those of the system,
            with kernels that have no place for others.

    Returns:
        The next state, and the fault () int32: 0, or 1 where anything was not
        finite or a velocity exceeded 1,000 [m/s or rad/s]; then ``q`` and ``v`` are
        the given ones (the default pose at rest if those are not finite), the
        impulses are zero and every gradient through the step is exactly zero.

    Raises:
        TypeError: The state, the control or a parameter has another type than the
            system.
        ValueError: The state, the control or a parameter has another shape, a
            parameter that is not traced is out of bounds, or an environment variable
            is wrong.
    """
    own = None if params is None else parameter_row(system, params)
    run = bridge.control_step(system)
    after, fault = run(state.q, state.v, control, own)
    return after, fault.astype(jnp.int32)
