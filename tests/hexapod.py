"""A hexapod as users bring one: light legs, joints with little or no damping.

Its own substeps of 5 ms are too long for contact that only linearises: under noise and
without damping, half of the worlds fault within 500 control steps.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from urdf_text import row, write

from newton_qd.robots import Contact, RobotSpec

TORSO, COXA, FEMUR, TIBIA = 1.5, 0.2, 0.2, 0.1  # masses [kg]
UPPER, LOWER = 0.1, 0.12  # lengths of femur and tibia [m]
RADIUS = 0.015  # of the legs [m]
GEAR = 4.0  # [N m]
NAMES = tuple(f"{side}{n}" for side in "lr" for n in range(3))


def part(name: str, length: float, mass: float, collides: bool) -> str:
    """A rod along x from the link's origin."""
    across, along = mass * RADIUS**2 / 2, mass * length**2 / 12
    shape = f'<capsule radius="{RADIUS}" height="{length}" length="{length}"/>'
    collision = f"""<collision>
      <origin xyz="{length / 2} 0 0" rpy="0 {np.pi / 2} 0"/>
      <geometry>{shape}</geometry></collision>"""
    return f"""<link name="{name}"><inertial><origin xyz="{length / 2} 0 0"/>
      <mass value="{mass}"/><inertia ixx="{across}" iyy="{along}" izz="{along}"
        ixy="0" ixz="0" iyz="0"/></inertial>{collision if collides else ""}</link>"""


def hinge(
    parent: str,
    child: str,
    place: str,
    axis: str,
    limits: tuple[float, float],
    damping: float,
) -> str:
    return f"""<joint name="{child}" type="revolute"><parent link="{parent}"/>
      <child link="{child}"/><origin {place}/><axis xyz="{axis}"/>
      <limit lower="{limits[0]}" upper="{limits[1]}" effort="{GEAR}" velocity="50"/>
      <dynamics damping="{damping}"/></joint>"""


def leg(name: str, damping: float) -> str:
    """Coxa, femur and tibia; all point outwards at zero angles."""
    side, n = (1 if name[0] == "l" else -1), int(name[1])
    yaw = side * np.pi / 2 + side * (n - 1) * 0.6
    place = f'xyz="{0.12 * (1 - n)} {side * 0.08} 0" rpy="0 0 {yaw}"'
    parts = [
        part(f"coxa_{name}", 0.03, COXA, False),
        part(f"femur_{name}", UPPER, FEMUR, False),
        part(f"tibia_{name}", LOWER, TIBIA, True),
        hinge("torso", f"coxa_{name}", place, "0 0 1", (-0.6, 0.6), damping),
        hinge(
            f"coxa_{name}",
            f"femur_{name}",
            'xyz="0.03 0 0"',
            "0 1 0",
            (-1.2, 1.0),
            damping,
        ),
        hinge(
            f"femur_{name}",
            f"tibia_{name}",
            f'xyz="{UPPER} 0 0"',
            "0 1 0",
            (0.2, 2.2),
            damping,
        ),
    ]
    return "".join(parts)


def hexapod(folder: Path, damping: float, **changes: object) -> RobotSpec:
    """The row of a hexapod whose URDF file is written into ``folder``.

    Args:
        folder: Where to write the file.
        damping: Of every joint [N m s/rad].
        **changes: Fields of the row.
    """
    text = f"""<robot name="hexapod"><link name="torso"><inertial>
      <mass value="{TORSO}"/><inertia ixx="0.004" iyy="0.01" izz="0.012" ixy="0"
        ixz="0" iyz="0"/></inertial>
      <collision><geometry><sphere radius="0.06"/></geometry></collision></link>
      {"".join(leg(name, damping) for name in NAMES)}</robot>"""
    feet = tuple(f"tibia_{name}" for name in NAMES)
    joints = [f"{kind}_{name}" for name in NAMES for kind in ("coxa", "femur", "tibia")]
    given: dict[str, object] = {
        "name": "hexapod",
        "feet": feet,
        "actuators": tuple((joint, GEAR) for joint in joints),
        "contacts": (Contact("torso"), *(Contact(foot, 1) for foot in feet)),
        "rest_pose": tuple((joint, 1.2) for joint in joints if joint[0] == "t"),
        "dt": 0.02,
        "substeps": 4,
        **changes,
    }
    return row(write(folder, text), "torso", **given)
