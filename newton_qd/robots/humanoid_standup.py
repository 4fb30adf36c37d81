"""The humanoid on its back: torso, shins and lower arms touch the ground."""

import dataclasses

from newton_qd.robots.humanoid import HUMANOID
from newton_qd.robots.spec import DEGREE, Contact

HUMANOID_STANDUP = dataclasses.replace(
    HUMANOID,
    name="humanoidstandup",
    contacts=(
        *(
            Contact("torso", end, name)
            for name in ("chest", "belly")
            for end in (1, -1)
        ),
        Contact("torso"),
        *HUMANOID.contacts,
        *(
            contact
            for side in ("right", "left")
            for contact in (
                Contact(f"{side}_lower_arm", end=1),
                Contact(f"{side}_lower_arm", end=-1),
                Contact(f"{side}_lower_arm"),
            )
        ),
    ),
    rest_pose=(
        ("abdomen_y", -22.5 * DEGREE),
        *((f"{side}_hip_y", 5 * DEGREE) for side in ("right", "left")),
        *((f"{side}_knee", -25 * DEGREE) for side in ("right", "left")),
        ("right_shoulder2", -45 * DEGREE),
        ("left_shoulder2", 45 * DEGREE),
        *((f"{side}_elbow", -20 * DEGREE) for side in ("right", "left")),
    ),
    rest_height=0.09,
    rest_rotation=(0.0, -90 * DEGREE, 0.0),
)
