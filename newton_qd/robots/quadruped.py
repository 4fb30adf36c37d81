"""Quadruped: a torso on four legs of three joints, which hold angles."""

from newton_qd.robots.spec import Contact, Material, RobotSpec

_LEGS = ("front_left", "front_right", "back_left", "back_right")
_STIFFNESS = 60.0  # [N m/rad]: a knee yields by 0.06 to 0.1 rad under the weight

QUADRUPED = RobotSpec(
    name="quadruped",
    urdf="quadruped.urdf",
    torso="torso",
    feet=tuple(f"shank_{leg}" for leg in _LEGS),
    actuators=tuple(
        (f"{joint}_{leg}", _STIFFNESS)
        for leg in _LEGS
        for joint in ("hip", "thigh", "knee")
    ),
    servos=tuple(
        f"{joint}_{leg}" for leg in _LEGS for joint in ("hip", "thigh", "knee")
    ),
    contacts=(
        *(
            Contact("torso", end, f"{side}_rail")
            for side in ("left", "right")
            for end in (1, -1)
        ),
        *(Contact(f"thigh_{leg}", end=-1) for leg in _LEGS),
        *(Contact(f"shank_{leg}", collider="foot") for leg in _LEGS),
    ),
    # the middle of each joint's range
    rest_pose=tuple(
        pose for leg in _LEGS for pose in ((f"thigh_{leg}", 0.9), (f"knee_{leg}", -1.8))
    ),
    dt=0.03,
    substeps=5,
    # less than half the radius of a foot
    material=Material(smoothing=0.01),
)
