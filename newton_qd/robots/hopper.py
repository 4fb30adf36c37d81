"""Hopper: a torso on one leg, in a plane."""

from newton_qd.robots.spec import Contact, Material, RobotSpec

HOPPER = RobotSpec(
    name="hopper",
    urdf="hopper.urdf",
    torso="torso",
    feet=("foot",),
    actuators=tuple(
        (joint, 200.0) for joint in ("thigh_joint", "leg_joint", "foot_joint")
    ),
    contacts=tuple(
        Contact(link, end)
        for link in ("torso", "thigh", "leg", "foot")
        for end in (1, -1)
    ),
    rest_pose=(),
    rest_height=1.25,
    dt=0.008,
    substeps=2,
    # the two ends of the foot carry the weight
    material=Material(friction=0.9, support=2, smoothing=0.015),
)
