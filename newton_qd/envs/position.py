"""Where the robot is."""

from __future__ import annotations

import jax

from newton_qd import physics
from newton_qd.physics.system import JointKind, PhysicsState, System


def torso_xy(system: System, state: PhysicsState) -> jax.Array:
    """Position of the torso on the ground.

    Args:
        system: The system.
        state: State of one world.

    Returns:
        (2,) x and y of the torso's link frame in the world [m].
    """
    if system.joint_kind[system.torso] == JointKind.FREE:
        start = int(system.q_start[system.torso])
        return state.q[start : start + 2]
    kinematics = physics.forward_kinematics(system, state.q, state.v)
    return kinematics.position[system.torso, :2]
