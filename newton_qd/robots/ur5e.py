"""UR5e: an arm of six hinges over the floor, and a target."""

from newton_qd.robots.spec import RobotSpec

UR5E = RobotSpec(
    name="ur5e",
    urdf="ur5e.urdf",
    torso="wrist_3_link",
    feet=(),
    actuators=tuple(
        (f"{joint}_joint", 100.0)
        for joint in (
            "shoulder_pan",
            "shoulder_lift",
            "elbow",
            "wrist_1",
            "wrist_2",
            "wrist_3",
        )
    ),
    contacts=(),
    # target of a reset without noise: the mean radius that resets draw
    rest_pose=(("target_x", 0.27),),
    dt=0.02,
    substeps=2,
)
