"""Grasp: a hand of four fingers over an object, and a target for the object."""

from newton_qd.robots.spec import DEGREE, Contact, Material, RobotSpec

_OBJECT = Contact("object")
_BENT = 45 * DEGREE
# Damping of the palm's slides [N s/m], as in the file. The palm goes 15 % of the way to
# its target in a control step, as in the original: 1 - exp(-0.02 s * gear / damping).
_PALM_DAMPING, _PALM_RATE = 4000.0, 8.12594647

GRASP = RobotSpec(
    name="grasp",
    urdf="grasp.urdf",
    torso="object",
    actuators=(
        *(
            (f"finger_{finger}_{joint}", 300.0)
            for finger in (1, 2, 3, 4)
            for joint in ("distal", "middle", "swing", "twist")
        ),
        *((f"palm_{axis}", _PALM_DAMPING * _PALM_RATE) for axis in "xyz"),
    ),
    servos=(
        *(
            f"finger_{finger}_{joint}"
            for finger in (1, 2, 3, 4)
            for joint in ("distal", "middle", "swing", "twist")
        ),
        *(f"palm_{axis}" for axis in "xyz"),
    ),
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
        ("palm_z", 3.3106601717798213),
        ("target_z", 1.1),
    ),
    dt=0.02,
    substeps=4,
    gravity=9.8,
    # friction is that of a pair; contacts carry the object alone, a fourteenth of the
    # weight, so they are softer than for a robot that stands
    material=Material(friction=0.6, support=16),
)
