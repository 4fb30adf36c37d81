"""Acrobot: two poles that hang from a mount. The joint between them is driven."""

from newton_qd.robots.spec import DEGREE, RobotSpec

ACROBOT = RobotSpec(
    name="acrobot",
    urdf="acrobot.urdf",
    torso="pole",
    feet=(),
    actuators=(("hinge2", 25.0),),
    contacts=(),
    rest_pose=(("hinge", 180 * DEGREE),),
    dt=0.01,
    substeps=4,
)
