"""Humanoid: a trunk of three bodies, two legs and two arms, 17 driven axes."""

from newton_qd.robots.spec import DEGREE, Contact, Material, RobotSpec

_FEET = ("left_shin", "right_shin")
_STRONG, _WEAK = 350.0, 100.0  # gears of trunk and legs, and of the arms [N m]

HUMANOID = RobotSpec(
    name="humanoid",
    urdf="humanoid.urdf",
    torso="torso",
    feet=_FEET,
    actuators=(
        *((f"abdomen_{axis}", _STRONG) for axis in ("z", "y", "x")),
        *(
            (f"{side}_{joint}", _STRONG)
            for side in ("right", "left")
            for joint in ("hip_x", "hip_y", "hip_z", "knee")
        ),
        *(
            (f"{side}_{joint}", _WEAK)
            for side in ("right", "left")
            for joint in ("shoulder1", "shoulder2", "elbow")
        ),
    ),
    contacts=tuple(
        contact for shin in _FEET for contact in (Contact(shin, end=1), Contact(shin))
    ),
    rest_pose=(
        ("abdomen_y", -22.5 * DEGREE),
        ("right_hip_y", 20 * DEGREE),
        ("right_knee", -25 * DEGREE),
        ("left_hip_y", 20 * DEGREE),
        ("left_knee", -25 * DEGREE),
        ("right_shoulder1", -12.5 * DEGREE),
        ("right_shoulder2", -12.5 * DEGREE),
        ("right_elbow", -20 * DEGREE),
        ("left_shoulder1", 12.5 * DEGREE),
        ("left_shoulder2", 12.5 * DEGREE),
        ("left_elbow", -20 * DEGREE),
    ),
    dt=0.015,
    substeps=2,
    # Two spheres, one in each foot, carry the weight. The limit torque at the limit is
    # 1.9 % of the gear.
    material=Material(support=2, limit_overshoot=0.1, limit_smoothing=0.01),
)
