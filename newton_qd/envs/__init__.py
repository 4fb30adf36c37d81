"""Environments: observation, reward and end of an episode over the physics."""

from newton_qd.envs.ant import Ant
from newton_qd.envs.base import Env, PhysicsEnv, QDEnv
from newton_qd.envs.halfcheetah import HalfCheetah
from newton_qd.envs.hopper import Hopper
from newton_qd.envs.humanoid import Humanoid
from newton_qd.envs.humanoid_trap import HumanoidTrap
from newton_qd.envs.locomotion import Locomotion
from newton_qd.envs.pointmaze import PointMaze
from newton_qd.envs.state import State, check
from newton_qd.envs.walker2d import Walker2d

__all__ = [
    "Ant",
    "Env",
    "HalfCheetah",
    "Hopper",
    "Humanoid",
    "HumanoidTrap",
    "Locomotion",
    "PhysicsEnv",
    "PointMaze",
    "QDEnv",
    "State",
    "Walker2d",
    "check",
]
