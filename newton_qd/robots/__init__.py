"""Robots as data: one file and one row each."""

from newton_qd.robots.ant import ANT
from newton_qd.robots.humanoid import HUMANOID
from newton_qd.robots.row import Contact, Material, Robot

ROBOTS = {robot.name: robot for robot in (ANT, HUMANOID)}

__all__ = ["ANT", "HUMANOID", "ROBOTS", "Contact", "Material", "Robot"]
