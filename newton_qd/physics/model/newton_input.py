"""What Newton gets of a URDF file, and the masses of links that it merges.

Newton 1.8 reads a file otherwise than this package in three places: it reads the
``height`` of a capsule only, it downloads meshes, and it merges the inertia of fixed
links about a wrong point.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from newton_qd.checks import Fact, message
from newton_qd.physics.model.description import merged_inertia
from newton_qd.physics.model.xml_reader import (
    IDENTITY,
    RobotDescriptionWarning,
    XmlReader,
    asset_file,
)
from newton_qd.physics.reference import compose, inverse, rotation_matrix

_READ = ("link", "joint", "material")


def newton_text(path: Path, *, meshes: bool) -> str:
    """Returns a URDF file as Newton should read it.

    Args:
        path: The file.
        meshes: Whether Newton may read the files of meshes and textures. It never
            downloads one.

    Raises:
        RobotDescriptionError: The file is not XML.
        OSError: The file cannot be read.
    """
    root = XmlReader(path).root
    for child in list(root):
        if child.tag not in _READ:
            root.remove(child)
    _drop_prefixed(root)
    for capsule in root.iter("capsule"):
        if capsule.get("height") is None and capsule.get("length") is not None:
            capsule.set("height", capsule.attrib["length"])
    skipped = []
    for parent in list(root.iter()):
        for child in list(parent):
            name = child.get("filename")
            if child.tag not in ("mesh", "texture") or name is None:
                continue
            if not meshes or name.startswith(("http://", "https://")):
                parent.remove(child)
                skipped += [name] if meshes else []
                continue
            # Newton has the text only, so it does not know the folder of the file.
            found = asset_file(path, name)
            if found is not None:
                child.set("filename", str(found))
    if skipped:
        allowed = "files on this machine; what has another address is not drawn"
        given = Fact(", ".join(dict.fromkeys(skipped)))
        text = message(f"{path}: filename", given, allowed)
        warnings.warn(text, RobotDescriptionWarning, stacklevel=3)
    return ElementTree.tostring(root, encoding="unicode")


def _drop_prefixed(element: ElementTree.Element) -> None:
    """Removes names with a prefix: simulator extensions, and macros of xacro."""
    for name in [name for name in element.attrib if ":" in name]:
        del element.attrib[name]
    for child in list(element):
        if ":" in child.tag:
            element.remove(child)
        else:
            _drop_prefixed(child)


def merge_fixed_bodies(builder: Any, fixed: list[bool]) -> None:
    """Removes fixed joints. The body that remains has the mass of all merged bodies.

    Args:
        builder: A ``newton.ModelBuilder`` with one robot, joints of parents first.
        fixed: Whether each joint is fixed.
    """
    # Newton 1.8 adds the inertia of a merged link about the origin of the body, not
    # about the common centre of mass.
    carrier, frames = {-1: -1}, {-1: IDENTITY}
    for joint, child in enumerate(builder.joint_child):
        parent = builder.joint_parent[joint]
        before, after = (
            _numbers(x[joint]) for x in (builder.joint_X_p, builder.joint_X_c)
        )
        frame = compose(before, inverse(after))
        carrier[child] = carrier[parent] if fixed[joint] else child
        frames[child] = compose(frames[parent], frame) if fixed[joint] else IDENTITY
    parts: dict[str, list[tuple[float, np.ndarray, np.ndarray]]] = {}
    merged = set()
    for body, frame in frames.items():
        if body < 0 or carrier[body] < 0 or not builder.body_mass[body] > 0:
            continue
        label = builder.body_label[carrier[body]]
        rotation = rotation_matrix(frame[3:])
        com = frame[:3] + rotation @ _numbers(builder.body_com[body])
        inertia = _numbers(builder.body_inertia[body]).reshape(3, 3)
        part = (float(builder.body_mass[body]), com, rotation @ inertia @ rotation.T)
        parts.setdefault(label, []).append(part)
        if carrier[body] != body:
            merged.add(label)
    builder.collapse_fixed_joints()
    for body, label in enumerate(builder.body_label):
        if label not in merged:
            continue
        mass, com, inertia = merged_inertia(parts[label])
        vector, matrix = type(builder.body_com[body]), type(builder.body_inertia[body])
        builder.body_mass[body] = mass
        builder.body_inv_mass[body] = 1.0 / mass
        builder.body_com[body] = vector(*com)
        builder.body_inertia[body] = matrix(*inertia.ravel())
        # A rod has no inverse. Newton writes zeros for it, too.
        if np.linalg.matrix_rank(inertia) == 3:
            inverted = np.linalg.inv(inertia)
        else:
            inverted = np.zeros((3, 3))
        builder.body_inv_inertia[body] = matrix(*inverted.ravel())


def _numbers(array: object) -> np.ndarray:
    return np.array(array, dtype=np.float64)
