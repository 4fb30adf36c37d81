"""Environments: observation, reward and end of an episode over the physics."""

from newton_qd.envs.ant import Ant
from newton_qd.envs.base import Env, PhysicsEnv, QDEnv, State, check
from newton_qd.envs.halfcheetah import HalfCheetah
from newton_qd.envs.hopper import Hopper
from newton_qd.envs.walker2d import Walker2d

__all__ = [
    "Ant",
    "Env",
    "HalfCheetah",
    "Hopper",
    "PhysicsEnv",
    "QDEnv",
    "State",
    "Walker2d",
    "check",
]
