"""Reacher: an arm of two links over the ground, and a target."""

from newton_qd.robots.spec import RobotSpec

REACHER = RobotSpec(
    name="reacher",
    urdf="reacher.urdf",
    torso="body0",
    feet=(),
    actuators=(("joint0", 25.0), ("joint1", 25.0)),
    contacts=(),
    # target of a reset without noise: within reach, not on the stretched arm
    rest_pose=(("target_x", 0.1), ("target_y", 0.1)),
    dt=0.02,
    substeps=2,
)
