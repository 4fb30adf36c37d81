"""Halfcheetah: a trunk on a back and a front leg, in a plane."""

from newton_qd.robots.spec import Contact, Material, RobotSpec

_LEG_PARTS = ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")

HALFCHEETAH = RobotSpec(
    name="halfcheetah",
    urdf="halfcheetah.urdf",
    torso="torso",
    feet=("ffoot", "bfoot"),
    actuators=(
        ("bthigh", 120.0),
        ("bshin", 90.0),
        ("bfoot", 60.0),
        ("fthigh", 120.0),
        ("fshin", 60.0),
        ("ffoot", 30.0),
    ),
    contacts=(
        *(Contact("torso", end, name) for name in ("trunk", "head") for end in (1, -1)),
        *(Contact(link, end) for link in _LEG_PARTS for end in (1, -1)),
    ),
    pairs=((Contact("bfoot"), Contact("ffoot")),),
    # the middle of each joint's range
    rest_pose=(
        ("bthigh", 0.265),
        ("bfoot", 0.1925),
        ("fthigh", -0.15),
        ("fshin", -0.165),
    ),
    dt=0.05,
    # the feet are light and undamped and turn at 100 rad/s: 0.3 rad in a substep
    substeps=16,
    # chosen by energy, order and gradients of motion, and so that open-loop gaits
    # earn what they do in the original (benchmarks/contact.py, results/gaits.md)
    material=Material(
        friction=0.6,
        static_penetration=0.0035,
        limit_overshoot=0.05,
        limit_swing=0.36,
        limit_smoothing=0.02,
        # without it, a foot would bounce between its limits for ever
        limit_dissipation=0.5,
    ),
)
