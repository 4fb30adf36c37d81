"""Environments: observation, reward and end of an episode over the physics."""

from newton_qd.envs.ant import Ant
from newton_qd.envs.base import Env, PhysicsEnv, QDEnv, State, check
from newton_qd.envs.humanoid import Humanoid
from newton_qd.envs.humanoid_trap import HumanoidTrap

__all__ = [
    "Ant",
    "Env",
    "Humanoid",
    "HumanoidTrap",
    "PhysicsEnv",
    "QDEnv",
    "State",
    "check",
]
