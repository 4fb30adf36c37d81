"""Robots as data: one file and one row each."""

from newton_qd.robots.ant import ANT
from newton_qd.robots.halfcheetah import HALFCHEETAH
from newton_qd.robots.hopper import HOPPER
from newton_qd.robots.humanoid import HUMANOID
from newton_qd.robots.row import Contact, Material, Robot
from newton_qd.robots.walker2d import WALKER2D

ROBOTS = {robot.name: robot for robot in (ANT, HALFCHEETAH, HOPPER, HUMANOID, WALKER2D)}

__all__ = [
    "ANT",
    "HALFCHEETAH",
    "HOPPER",
    "HUMANOID",
    "ROBOTS",
    "WALKER2D",
    "Contact",
    "Material",
    "Robot",
]
