"""Inverted pendulum: a pole on a cart."""

from newton_qd.robots.spec import RobotSpec

INVERTED_PENDULUM = RobotSpec(
    name="inverted_pendulum",
    urdf="inverted_pendulum.urdf",
    torso="cart",
    feet=(),
    actuators=(("slider", 100.0),),
    contacts=(),
    rest_pose=(),
    dt=0.04,
    substeps=4,
)
