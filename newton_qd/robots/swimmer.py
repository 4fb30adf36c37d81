"""Swimmer: three links in a row that float in a plane."""

from newton_qd.robots.spec import RobotSpec

SWIMMER = RobotSpec(
    name="swimmer",
    urdf="swimmer.urdf",
    torso="torso",
    feet=(),
    # The action drives the joints. The drag of the water acts on the root too.
    actuators=(
        ("rot2", 30.0),
        ("rot3", 30.0),
        ("root_x", 1.0),
        ("root_y", 1.0),
        ("root_yaw", 1.0),
    ),
    contacts=(),
    rest_pose=(),
    dt=0.04,
    substeps=4,
    gravity=0.0,
)
