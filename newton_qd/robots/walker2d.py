"""Walker2d: a torso on two legs, in a plane."""

from newton_qd.robots.spec import Contact, Material, RobotSpec

_LEGS = ("", "_left")

WALKER2D = RobotSpec(
    name="walker2d",
    urdf="walker2d.urdf",
    torso="torso",
    feet=tuple(f"foot{leg}" for leg in _LEGS),
    actuators=tuple(
        (f"{part}{leg}_joint", 100.0)
        for leg in _LEGS
        for part in ("thigh", "leg", "foot")
    ),
    contacts=tuple(
        Contact(link, end)
        for link in (
            "torso",
            *(f"{part}{leg}" for leg in _LEGS for part in ("thigh", "leg", "foot")),
        )
        for end in (1, -1)
    ),
    rest_pose=(),
    rest_height=1.19,
    dt=0.008,
    substeps=2,
    # it starts 20 mm below the ground, as in the original; dissipation limits the jump
    material=Material(friction=0.9, smoothing=0.015, dissipation=1.0),
)
