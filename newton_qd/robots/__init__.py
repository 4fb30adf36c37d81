"""Robots as data: one file and one row each."""

from newton_qd.robots.ant import ANT
from newton_qd.robots.row import Contact, Material, Robot

ROBOTS = {robot.name: robot for robot in (ANT,)}

__all__ = ["ANT", "ROBOTS", "Contact", "Material", "Robot"]
