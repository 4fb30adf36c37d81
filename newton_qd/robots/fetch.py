"""Fetch: a dog of eleven boxes and ten hinges, and a target."""

from newton_qd.robots.spec import Contact, Material, RobotSpec

_LEGS = ("front_right", "front_left", "back_right", "back_left")

FETCH = RobotSpec(
    name="fetch",
    urdf="fetch.urdf",
    torso="torso",
    feet=tuple(f"{leg}_lower" for leg in _LEGS),
    actuators=tuple(
        (f"{part}_joint", 300.0)
        for part in (
            "shoulders",
            "hips",
            *(f"{leg}_{half}" for leg in _LEGS for half in ("upper", "lower")),
        )
    ),
    contacts=tuple(Contact(f"{leg}_lower") for leg in _LEGS),
    # target of a reset without noise: the mean radius that resets draw
    rest_pose=(("target_x", 9.5),),
    dt=0.02,
    substeps=2,
    gravity=9.8,
    # the lower corners of four legs carry the dog; friction is that of a pair
    material=Material(friction=0.6, support=16),
)
