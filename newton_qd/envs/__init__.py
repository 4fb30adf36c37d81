"""Environments: observation, reward and end of an episode over the physics."""

from newton_qd.envs.ant import Ant
from newton_qd.envs.base import Env, PhysicsEnv, QDEnv
from newton_qd.envs.pointmaze import PointMaze
from newton_qd.envs.state import State, check

__all__ = ["Ant", "Env", "PhysicsEnv", "PointMaze", "QDEnv", "State", "check"]
