"""Pusher: an arm of seven hinges over a table, and an object that it pushes."""

import dataclasses

from newton_qd.robots.spec import DEGREE, Contact, Material, RobotSpec

# Colliders of the arm that touch the table and the object.
_CAPSULES = tuple(
    Contact(link, collider=name)
    for link, name in (
        ("r_forearm_roll_link", "forearm_roll"),
        ("r_forearm_roll_link", "forearm"),
        ("r_wrist_roll_link", "palm"),
        ("r_wrist_roll_link", "right_finger"),
        ("r_wrist_roll_link", "left_finger"),
    )
)
_SPHERES = tuple(
    Contact("r_wrist_roll_link", collider=name) for name in ("right_tip", "left_tip")
)
_OBJECT = Contact("object")

PUSHER = RobotSpec(
    name="pusher",
    urdf="pusher.urdf",
    torso="object",
    feet=(),
    actuators=tuple(
        (f"r_{joint}_joint", 100.0)
        for joint in (
            "shoulder_pan",
            "shoulder_lift",
            "upper_arm_roll",
            "elbow_flex",
            "forearm_roll",
            "wrist_flex",
            "wrist_roll",
        )
    ),
    contacts=(
        _OBJECT,
        *(
            Contact(part.link, end, part.collider)
            for part in _CAPSULES
            for end in (1, -1)
        ),
        *_SPHERES,
    ),
    pairs=tuple((part, _OBJECT) for part in (*_CAPSULES, *_SPHERES)),
    rest_pose=(
        # the middle of each joint's range
        ("r_shoulder_pan_joint", -16.3521565 * DEGREE),
        ("r_shoulder_lift_joint", 25.0010155 * DEGREE),
        ("r_upper_arm_roll_joint", 5.729577 * DEGREE),
        ("r_elbow_flex_joint", -66.50035 * DEGREE),
        ("r_wrist_flex_joint", -31.3407915 * DEGREE),
        # the mean of the positions that resets draw
        ("object_x", -0.15),
    ),
    dt=0.05,
    substeps=10,
    gravity=0.0,
    # no friction, as in the original; half the radius of the tips
    material=Material(friction=0.0, support=1, smoothing=0.005, limit_swing=0.3),
)

# without a goal, on a table that slows the object down
PUSHER_TABLE = dataclasses.replace(
    PUSHER, name="pusher_table", urdf="pusher_table.urdf"
)
