"""Environments: observation, reward and end of an episode over the physics."""

from newton_qd.envs.acrobot import Acrobot
from newton_qd.envs.ant import Ant
from newton_qd.envs.arm_reach import ArmReach
from newton_qd.envs.base import Env, PhysicsEnv, QDEnv
from newton_qd.envs.fetch import Fetch
from newton_qd.envs.grasp import Grasp
from newton_qd.envs.halfcheetah import HalfCheetah
from newton_qd.envs.hopper import Hopper
from newton_qd.envs.humanoid import Humanoid
from newton_qd.envs.humanoid_standup import HumanoidStandup
from newton_qd.envs.humanoid_trap import HumanoidTrap
from newton_qd.envs.inverted_pendulum import InvertedDoublePendulum, InvertedPendulum
from newton_qd.envs.locomotion import Locomotion
from newton_qd.envs.pointmaze import PointMaze
from newton_qd.envs.pusher import Pusher, TablePusher
from newton_qd.envs.quadruped import Quadruped
from newton_qd.envs.reacher import Reacher, ReacherAngle
from newton_qd.envs.state import State, check
from newton_qd.envs.swimmer import Swimmer
from newton_qd.envs.ur5e import Ur5e
from newton_qd.envs.walker2d import Walker2d

__all__ = [
    "Acrobot",
    "Ant",
    "ArmReach",
    "Env",
    "Fetch",
    "Grasp",
    "HalfCheetah",
    "Hopper",
    "Humanoid",
    "HumanoidStandup",
    "HumanoidTrap",
    "InvertedDoublePendulum",
    "InvertedPendulum",
    "Locomotion",
    "PhysicsEnv",
    "PointMaze",
    "Pusher",
    "QDEnv",
    "Quadruped",
    "Reacher",
    "ReacherAngle",
    "State",
    "Swimmer",
    "TablePusher",
    "Ur5e",
    "Walker2d",
    "check",
]
