"""Robots as data: one file and one spec each."""

from __future__ import annotations

from typing import Any

from newton_qd.moved import moved_name
from newton_qd.robots.acrobot import ACROBOT
from newton_qd.robots.ant import ANT
from newton_qd.robots.fetch import FETCH
from newton_qd.robots.grasp import GRASP
from newton_qd.robots.halfcheetah import HALFCHEETAH
from newton_qd.robots.hopper import HOPPER
from newton_qd.robots.humanoid import HUMANOID
from newton_qd.robots.humanoid_standup import HUMANOID_STANDUP
from newton_qd.robots.inverted_double_pendulum import INVERTED_DOUBLE_PENDULUM
from newton_qd.robots.inverted_pendulum import INVERTED_PENDULUM
from newton_qd.robots.pusher import PUSHER, PUSHER_TABLE
from newton_qd.robots.quadruped import QUADRUPED
from newton_qd.robots.reacher import REACHER
from newton_qd.robots.reacherangle import REACHERANGLE
from newton_qd.robots.spec import Contact, Material, RobotSpec
from newton_qd.robots.swimmer import SWIMMER
from newton_qd.robots.ur5e import UR5E
from newton_qd.robots.walker2d import WALKER2D

ROBOTS = {
    robot.name: robot
    for robot in (
        ANT,
        HALFCHEETAH,
        HOPPER,
        HUMANOID,
        WALKER2D,
        ACROBOT,
        FETCH,
        GRASP,
        HUMANOID_STANDUP,
        INVERTED_DOUBLE_PENDULUM,
        INVERTED_PENDULUM,
        PUSHER,
        REACHER,
        REACHERANGLE,
        SWIMMER,
        UR5E,
        QUADRUPED,
    )
}

__all__ = [
    "ACROBOT",
    "ANT",
    "FETCH",
    "GRASP",
    "HALFCHEETAH",
    "HOPPER",
    "HUMANOID",
    "HUMANOID_STANDUP",
    "INVERTED_DOUBLE_PENDULUM",
    "INVERTED_PENDULUM",
    "PUSHER",
    "PUSHER_TABLE",
    "QUADRUPED",
    "REACHER",
    "REACHERANGLE",
    "ROBOTS",
    "SWIMMER",
    "UR5E",
    "WALKER2D",
    "Contact",
    "Material",
    "RobotSpec",
]


def __getattr__(name: str) -> Any:
    """Returns a renamed object by its old name."""
    return moved_name(__name__, name, {"Robot": "newton_qd.robots.RobotSpec"})
