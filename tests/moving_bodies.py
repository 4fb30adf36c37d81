"""Worlds of several moving bodies, each on slides and hinges of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from urdf_text import joint, row, write

from newton_qd.physics import reference
from newton_qd.physics.model import build_system
from newton_qd.physics.system import System
from newton_qd.robots import Contact, Material

AXES = ("1 0 0", "0 1 0", "0 0 1")
UNLIMITED = '<limit lower="-1e10" upper="1e10" effort="1" velocity="1"/>'


def ball(radius: float) -> str:
    return f"<collision><geometry><sphere radius='{radius}'/></geometry></collision>"


def rod(radius: float, height: float) -> str:
    shape = f"<capsule radius='{radius}' height='{height}'/>"
    return f"<collision><geometry>{shape}</geometry></collision>"


def body(
    name: str, collider: str, slides: str = "xyz", turns: str = "", mass: float = 1.0
) -> str:
    """A link on a chain of slides and hinges from the world, in URDF."""
    moves = [("prismatic", axis) for axis in slides]
    moves += [("continuous", axis) for axis in turns]
    links = [f"{name}_{n}" for n in range(len(moves) - 1)] + [name]
    text, parent = "", "world"
    for link, (kind, axis) in zip(links, moves, strict=True):
        inside = f'<axis xyz="{AXES["xyz".index(axis)]}"/>'
        inside += UNLIMITED if kind == "prismatic" else ""
        text += joint(f"{link}_joint", kind, parent, link, inside)
        text += f'<link name="{link}"/>' if link != name else ""
        parent = link
    inertia = 0.02 * mass
    return f"""{text}<link name="{name}"><inertial><mass value="{mass}"/>
      <inertia ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0"
        iyz="0"/></inertial>{collider}</link>"""


def world(folder: Path, *bodies: str, **changes: Any) -> System:
    """Several roots in one world; ``a`` touches every other body."""
    text = f'<robot name="world"><link name="world"/>{"".join(bodies)}</robot>'
    names = [name for name in "bc" if f'<link name="{name}">' in text]
    pairs = tuple((Contact("a"), Contact(name)) for name in names)
    given = {"gravity": 0.0, "dt": 0.01, "substeps": 1, "pairs": pairs, **changes}
    given.setdefault("material", Material(support=1))
    return build_system(row(write(folder, text), "a", **given), "float64")


def turning_rods(folder: Path) -> System:
    """Two free rods of 0.6 m, one of them heavy."""
    rods = [rod(0.05, 0.6), rod(0.04, 0.5)]
    bodies = body("a", rods[0], turns="xyz"), body("b", rods[1], turns="xyz", mass=4.0)
    return world(folder, *bodies, dt=0.005)


def crossing(rng: np.random.Generator, worlds: int) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates and velocities of rods whose axes are 70 to 95 mm apart."""
    q = np.zeros((worlds, 12))
    q[:, 3:6], q[:, 9:] = rng.uniform(-1.2, 1.2, (2, worlds, 3))
    shares = rng.uniform(-1.1, 1.1, (worlds, 2))
    for world in range(worlds):
        ends = []
        for at, half in ((3, 0.3), (9, 0.25)):
            turns = np.eye(4)[3]
            for axis, angle in zip(np.eye(3), q[world, at : at + 3], strict=True):
                turn = reference.axis_quaternion(axis, angle)
                turns = reference.quaternion_product(turns, turn)
            ends.append(half * reference.rotation_matrix(turns)[:, 2])
        across = np.cross(*ends)
        across /= np.linalg.norm(across)
        place = shares[world, 0] * ends[0] - shares[world, 1] * ends[1]
        q[world, 6:9] = place + rng.uniform(0.07, 0.095) * across
    return q, rng.normal(size=(worlds, 12))
