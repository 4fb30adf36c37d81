"""Small robots for tests: pieces of URDF text, and rows with next to nothing."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from newton_qd.robots import RobotSpec


def write(folder: Path, text: str) -> str:
    path = folder / "robot.urdf"
    path.write_text(text, encoding="utf-8")
    return str(path)


def row(urdf: str, torso: str, **changes: object) -> RobotSpec:
    empty = RobotSpec("test", urdf, torso, (), (), (), (), dt=0.02, substeps=2)
    return dataclasses.replace(empty, **changes)


def link(name: str, inside: str = "", mass: float = 1.0) -> str:
    return f"""<link name="{name}"><inertial><mass value="{mass}"/>
      <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
      {inside}</link>"""


def joint(name: str, kind: str, parent: str, child: str, inside: str = "") -> str:
    return f"""<joint name="{name}" type="{kind}"><parent link="{parent}"/>
      <child link="{child}"/>{inside}</joint>"""


def sphere(radius: float, origin: str = "0 0 0") -> str:
    return f"""<collision><origin xyz="{origin}"/><geometry>
      <sphere radius="{radius}"/></geometry></collision>"""
