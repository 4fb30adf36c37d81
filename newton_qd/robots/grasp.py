"""Grasp: a hand of four fingers over an object, and a target for the object."""

import math

from newton_qd.robots.spec import DEGREE, Contact, Material, RobotSpec

_OBJECT = Contact("object")
_DT = 0.02
_BENT = 45 * DEGREE
# The tips of the bent fingers are on the ground. Their last links hang down from hinges
# at 1.75 m, the middle links go down by 45 degrees, and the first links are level.
_PALM_HEIGHT = 1.75 + 1.5 * math.sin(_BENT) + 0.5
# Damping of the palm's slides [N s/m], as in the file. The palm goes 15 % of the way to
# its target in a control step, as in the original: 1 - exp(-dt * gear / damping).
_PALM_DAMPING = 4000.0
_PALM_GEAR = -math.log(1 - 0.15) / _DT * _PALM_DAMPING

_ACTUATORS = (
    *(
        (f"finger_{finger}_{joint}", 300.0)
        for finger in (1, 2, 3, 4)
        for joint in ("distal", "middle", "swing", "twist")
    ),
    *((f"palm_{axis}", _PALM_GEAR) for axis in "xyz"),
)

GRASP = RobotSpec(
    name="grasp",
    urdf="grasp.urdf",
    torso="object",
    actuators=_ACTUATORS,
    servos=tuple(joint for joint, _ in _ACTUATORS),
    contacts=(Contact("object", 1), Contact("object", -1)),
    pairs=(
        *((Contact(f"finger_{finger}_distal"), _OBJECT) for finger in (1, 2, 3, 4)),
        (Contact("palm"), _OBJECT),
    ),
    rest_pose=(
        *(
            (f"finger_{finger}_{joint}", angle)
            for finger, angle in ((1, -_BENT), (2, _BENT), (3, _BENT), (4, _BENT))
            for joint in ("middle", "distal")
        ),
        ("palm_z", _PALM_HEIGHT),
        ("target_z", 1.1),
    ),
    dt=_DT,
    substeps=4,
    gravity=9.8,
    # friction is that of a pair; contacts carry the object alone, a fourteenth of the
    # weight, so they are softer than for a robot that stands
    material=Material(friction=0.6, support=16),
)
