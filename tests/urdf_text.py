"""Small robots for tests: pieces of URDF text, and rows with next to nothing."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from newton_qd.physics.model import RobotDescriptionError, build_system
from newton_qd.physics.system import System
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


def robot_text(*parts: str) -> str:
    """A robot of these elements."""
    return f"<robot name='r'>{''.join(parts)}</robot>"


def heavy(name: str, mass: float, com: str, moments: str, inside: str = "") -> str:
    """A link with an uneven inertia in turned axes."""
    ixx, iyy, izz = moments.split()
    return f"""<link name="{name}"><inertial><origin xyz="{com}" rpy="0.2 -0.4 0.7"/>
      <mass value="{mass}"/><inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0.001"
      ixz="0" iyz="-0.002"/></inertial>{inside}</link>"""


def built(folder: Path, text: str, torso: str, **changes: object) -> System:
    """The system of a robot's text in float32."""
    return build_system(row(write(folder, text), torso, **changes), "float32")


def refusal(folder: Path, text: str, torso: str, **changes: object) -> str:
    """The error that refuses a robot; it names the file."""
    with pytest.raises(RobotDescriptionError) as caught:
        built(folder, text, torso, **changes)
    assert str(folder / "robot.urdf") in str(caught.value)
    return str(caught.value)
