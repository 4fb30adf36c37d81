"""Ant: a torso on four legs of two joints."""

from newton_qd.robots.spec import DEGREE, Contact, RobotSpec

_ANT_LEGS = ("1", "2", "3", "4")

ANT = RobotSpec(
    name="ant",
    urdf="ant.urdf",
    torso="torso",
    feet=tuple(f"foot_{leg}" for leg in _ANT_LEGS),
    actuators=tuple(
        (f"{joint}_{leg}", 350.0) for leg in _ANT_LEGS for joint in ("hip", "ankle")
    ),
    contacts=(
        Contact("torso"),
        *(Contact(f"foot_{leg}", end=-1) for leg in _ANT_LEGS),
    ),
    rest_pose=(
        ("ankle_1", 50 * DEGREE),
        ("ankle_2", -50 * DEGREE),
        ("ankle_3", -50 * DEGREE),
        ("ankle_4", 50 * DEGREE),
    ),
    dt=0.05,
    substeps=5,
    gravity=9.8,
)
