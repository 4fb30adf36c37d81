"""Reacherangle: the arm of the reacher, with joints that hold angles."""

import dataclasses

from newton_qd.robots.reacher import REACHER

REACHERANGLE = dataclasses.replace(
    REACHER,
    name="reacherangle",
    urdf="reacherangle.urdf",
    actuators=(("joint0", 20.0), ("joint1", 20.0)),
    servos=("joint0", "joint1"),
)
