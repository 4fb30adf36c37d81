"""Inverted double pendulum: two poles, one on the other, on a cart."""

from newton_qd.robots.spec import RobotSpec

INVERTED_DOUBLE_PENDULUM = RobotSpec(
    name="inverted_double_pendulum",
    urdf="inverted_double_pendulum.urdf",
    torso="cart",
    feet=(),
    actuators=(("slider", 500.0),),
    contacts=(),
    rest_pose=(),
    dt=0.05,
    substeps=10,
)
