"""What Newton gets of a URDF file, and the masses of links that it merges.

Newton 1.8 reads a file otherwise than this package in three places: it reads the
``height`` of a capsule only, it downloads meshes, and it merges the inertia of fixed
links about a wrong point.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from newton_qd.checks import Fact, message
from newton_qd.errors import warn
from newton_qd.physics.model.description import merged_inertia
from newton_qd.physics.model.elements import WITHOUT_AXIS
from newton_qd.physics.model.mesh_files import Folders
from newton_qd.physics.model.xml_reader import (
    IDENTITY,
    RobotDescriptionWarning,
    XmlReader,
)
from newton_qd.physics.reference import compose, inverse, rotation_matrix

_READ = ("link", "joint", "material")
_MOTION = ("axis", "dynamics", "limit")


@dataclasses.dataclass(frozen=True, eq=False)
class Asset:
    """A mesh or a texture that a URDF file names.

    Attributes:
        element: The element ``<mesh>`` or ``<texture>``.
        parent: The element around it.
        collides: Whether it is the mesh of a collider.
        name: The name of its file in the URDF file.
    """

    element: ElementTree.Element
    parent: ElementTree.Element
    collides: bool
    name: str


class NewtonInput:
    """A URDF file as Newton should read it.

    A mesh or texture that is only seen, and that may not be read, is left out with a
    warning. All meshes that remain are below the allowed folders.

    Args:
        path: The file.
        meshes: Whether Newton may read the files of meshes and textures.
        packages: Folders whose files may be read, too.
        drawn: Whether Newton only draws the robot, so that nothing touches its meshes.
            The mesh of a collider may then be left out, too.

    Attributes:
        meshes: The meshes that Newton will read.

    Raises:
        RobotDescriptionError: The file is not XML, a colour is malformed, or the mesh
            of a collider may not be read.
        OSError: The file cannot be read.
    """

    def __init__(
        self,
        path: Path,
        meshes: bool,
        packages: Sequence[str | Path],
        drawn: bool = False,
    ):
        self.meshes: list[Asset] = []
        self._drawn = drawn
        self._reader = XmlReader(path)
        self._folders = Folders(path, packages)
        root = self._reader.root
        for child in list(root):
            if child.tag not in _READ:
                root.remove(child)
        _drop_prefixed(root)
        _drop_unread(root)
        for capsule in root.iter("capsule"):
            if capsule.get("height") is None and capsule.get("length") is not None:
                capsule.set("height", capsule.attrib["length"])
        parents = {child: parent for parent in root.iter() for child in parent}
        for element, parent in parents.items():
            if not meshes:
                if element.tag in ("material", "mesh"):
                    parent.remove(element)
            elif element.tag == "color" and element.get("rgba"):
                short = len(element.attrib["rgba"].split()) == 3  # no opacity
                values = self._reader.numbers(element, "rgba", 3 if short else 4)
                # NumPy, which Newton reads this with, knows fewer kinds of digits.
                element.set("rgba", " ".join(map(repr, values.tolist())))
            elif element.tag in ("mesh", "texture") and "filename" in element.attrib:
                above = parents.get(parent)
                collides = above is not None and above.tag == "collision"
                name = element.attrib["filename"]
                self._keep(Asset(element, parent, collides, name))

    def text(self) -> str:
        """Returns the text for Newton."""
        return ElementTree.tostring(self._reader.root, encoding="unicode")

    def leave_out_unreadable(self, new_builder: Callable[[], Any]) -> None:
        """Leaves out the meshes that Newton cannot read, with a warning for each.

        Args:
            new_builder: Makes an empty builder of Newton.

        Raises:
            RobotDescriptionError: One is the mesh of a collider, and is not only drawn.
        """
        for mesh in self.meshes:
            why = _mesh_problem(mesh, new_builder)
            if why:
                self._leave_out(mesh, why)

    def _leave_out(self, asset: Asset, why: str = "") -> None:
        """Leaves out a mesh or a texture that is only seen, with a warning.

        Raises:
            RobotDescriptionError: It is the mesh of a collider, and is not only drawn.
        """
        name, allowed = asset.name, self._folders.allowed
        if asset.collides and not self._drawn:
            field = "filename of a collider's mesh"
            text = message(field, name, allowed, why=why)
            raise self._reader.error(asset.element, text)
        asset.parent.remove(asset.element)
        allowed = f"{allowed}; another one is not drawn"
        text = message("filename", Fact(name), allowed, why=why)
        error = self._reader.error(asset.element, text)
        warn(str(error), RobotDescriptionWarning)

    def _keep(self, asset: Asset) -> None:
        """Keeps a mesh or a texture if it may be read."""
        found = self._folders.file(asset.name)
        if found is None:
            self._leave_out(asset)
            return
        why = self._folders.problem(found) if asset.element.tag == "mesh" else ""
        if why:
            self._leave_out(asset, why)
            return
        # Newton has the text only, so it does not know the folder of the file.
        asset.element.set("filename", str(found))
        if asset.element.tag == "mesh":
            self.meshes.append(asset)


def _mesh_problem(mesh: Asset, new_builder: Callable[[], Any]) -> str:
    """Returns why Newton cannot read a mesh; empty if it can."""
    element = ElementTree.Element("mesh", mesh.element.attrib)
    robot = ElementTree.Element("robot", name="mesh")
    link = ElementTree.SubElement(robot, "link", name="mesh")
    visual = ElementTree.SubElement(link, "visual")
    ElementTree.SubElement(visual, "geometry").append(element)
    text = ElementTree.tostring(robot, encoding="unicode")
    try:
        new_builder().add_urdf(text)
    except Exception as error:  # a reader of meshes may raise anything
        reason = " ".join(str(error).split())
        return f"which Newton cannot read ({type(error).__name__}: {reason})"
    return ""


def _drop_unread(root: ElementTree.Element) -> None:
    """Removes what this package does not read of joints, if Newton cannot read it."""
    for joint in root.iter("joint"):
        for child in list(joint):
            # what a joint without an axis says of one has no meaning
            if joint.get("type") in WITHOUT_AXIS and child.tag in _MOTION:
                joint.remove(child)
            for name in ("effort", "velocity"):
                if child.tag == "limit" and not _is_number(child.get(name, "0")):
                    del child.attrib[name]


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _drop_prefixed(element: ElementTree.Element) -> None:
    """Removes namespaces, and names with a prefix: extensions, and macros of xacro."""
    for name in [x for x in element.attrib if ":" in x or x == "xmlns"]:
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
