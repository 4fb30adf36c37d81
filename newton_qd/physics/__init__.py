"""Differentiable physics: systems, the control step, and functions that inspect it.

A function of a ``System`` raises ``TypeError`` if its first argument is something else.
"""

from newton_qd.physics.bridge import from_jax, to_jax
from newton_qd.physics.episodes import episode_final, episode_proportion
from newton_qd.physics.inspection import (
    bias_forces,
    contact_gaps,
    contact_impulses,
    forward_kinematics,
    lowest_contact,
    mass_matrix,
    on_ground,
    seen_bodies,
)
from newton_qd.physics.messages import quiet
from newton_qd.physics.model import load_system
from newton_qd.physics.model.limit_loads import SoftLimitWarning
from newton_qd.physics.model.rest import grounding_coordinate, raising_coordinate
from newton_qd.physics.model.substeps import FewSubstepsWarning, recommended_substeps
from newton_qd.physics.model.wall_speeds import SoftWallWarning, wall_speeds
from newton_qd.physics.parameters import PhysicsParams, default_params
from newton_qd.physics.step import initial_state, rollout, step, unit_quaternions
from newton_qd.physics.system import Kinematics, PhysicsState, System

quiet()

__all__ = [
    "FewSubstepsWarning",
    "Kinematics",
    "PhysicsParams",
    "PhysicsState",
    "SoftLimitWarning",
    "SoftWallWarning",
    "System",
    "bias_forces",
    "contact_gaps",
    "contact_impulses",
    "default_params",
    "episode_final",
    "episode_proportion",
    "forward_kinematics",
    "from_jax",
    "grounding_coordinate",
    "initial_state",
    "load_system",
    "lowest_contact",
    "mass_matrix",
    "on_ground",
    "raising_coordinate",
    "recommended_substeps",
    "rollout",
    "seen_bodies",
    "step",
    "to_jax",
    "unit_quaternions",
    "wall_speeds",
]
