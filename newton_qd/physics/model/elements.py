"""Reads the elements of a URDF file: colliders, links and joints.

Elements that the physics does not need are ignored: materials, transmissions and
simulator extensions. Unsupported content is an error.
"""

from __future__ import annotations

import dataclasses
import math
from xml.etree import ElementTree

import numpy as np

from newton_qd.checks import Fact, listed
from newton_qd.physics.model.xml_reader import XmlReader
from newton_qd.physics.reference import rotation_matrix

UNLIMITED = 1e9
"""A limit of this size or larger means no limit. Newton writes 1e10 [rad or m]."""

_JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed")
# Attributes that a shape must have. Newton uses 1 for a missing size.
_SHAPES = {
    "sphere": ("radius",),
    "capsule": ("radius", "height"),
    "cylinder": ("radius", "length"),
    "box": ("size",),
    "mesh": ("filename",),
}


@dataclasses.dataclass(frozen=True, eq=False)
class Shape:
    """A collider.

    Attributes:
        link: Name of the link that contains it in the file.
        kind: Tag of its geometry, for example ``"capsule"``.
        frame: (7,) position [m] and quaternion xyzw in the body.
        size: (3,) size as Newton stores it [m]. Sphere: radius. Capsule and cylinder:
            radius, half length of the straight part. Box: half extents.
        name: Name of the collider in the file. Empty if it has no name.
    """

    link: str
    kind: str
    frame: np.ndarray
    size: np.ndarray
    name: str = ""


@dataclasses.dataclass(frozen=True, eq=False)
class Joint:
    """A joint: ``frame`` (7,) in the parent link, ``axis`` (3,) in the joint frame."""

    name: str
    kind: str
    parent: str
    child: str
    frame: np.ndarray
    axis: np.ndarray
    lower: float
    upper: float
    damping: float


@dataclasses.dataclass(frozen=True, eq=False)
class Link:
    """A link: ``com`` (3,) [m], ``inertia`` (3, 3) about it in link axes [kg m^2]."""

    name: str
    mass: float
    com: np.ndarray
    inertia: np.ndarray
    shapes: tuple[Shape, ...]


def _read_shape(reader: XmlReader, element: ElementTree.Element, link: str) -> Shape:
    geometry = reader.child(element, "geometry")
    kinds = [child for child in geometry if child.tag in _SHAPES]
    if len(kinds) != 1 or len(geometry) != 1:
        found = ", ".join(child.tag for child in geometry) or "nothing"
        allowed = f"exactly one of {listed(_SHAPES)}"
        raise reader.refused(geometry, "shape", Fact(found), allowed)
    shape = kinds[0]
    size = np.zeros(3)
    if shape.tag == "mesh":
        reader.text(shape, "filename")
    elif shape.tag == "box":
        size[:] = reader.positive(shape, "size", 3) / 2
    else:
        for i, key in enumerate(_SHAPES[shape.tag]):
            size[i] = reader.positive(shape, key, 1)[0] / (1 if i == 0 else 2)
    # Newton reads the height of a capsule. MuJoCo reads its length.
    if shape.tag == "capsule" and shape.get("length") is not None:
        if 2 * size[1] != reader.number(shape, "length"):
            given = (shape.get("height"), shape.get("length"))
            allowed = "two equal numbers, as both mean the straight part"
            raise reader.refused(shape, "height, length", given, allowed)
    return Shape(link, shape.tag, reader.frame(element), size, element.get("name", ""))


def _read_inertial(
    reader: XmlReader, link: ElementTree.Element
) -> tuple[float, np.ndarray, np.ndarray]:
    """Returns mass, centre of mass (3,) and inertia (3, 3) about it, in link axes."""
    inertial = link.find("inertial")
    if inertial is None:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    mass = reader.positive(reader.child(inertial, "mass"), "value", 1)[0]
    element = reader.child(inertial, "inertia")
    inertia = np.empty((3, 3))
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        key = "i" + "xyz"[i] + "xyz"[j]
        inertia[i, j] = inertia[j, i] = reader.number(element, key)
    moments = np.linalg.eigvalsh(inertia)
    # For a real body, each principal moment is at most the sum of the other two.
    if moments[0] <= 0 or moments[2] > (moments[0] + moments[1]) * (1 + 1e-6):
        given = Fact(listed([f"{moment:g}" for moment in moments]))
        allowed = "positive, none larger than the sum of the other two"
        raise reader.refused(element, "principal moments", given, allowed)
    frame = reader.frame(inertial)
    rotation = rotation_matrix(frame[3:])
    return float(mass), frame[:3], rotation @ inertia @ rotation.T


def read_link(reader: XmlReader, element: ElementTree.Element) -> Link:
    """Reads a link: its inertia and its colliders.

    Raises:
        RobotDescriptionError: The link is malformed, or no real body has its inertia.
    """
    name = reader.text(element, "name")
    mass, com, inertia = _read_inertial(reader, element)
    for visual in element.findall("visual"):
        _read_shape(reader, visual, name)
    shapes = [
        _read_shape(reader, collision, name)
        for collision in element.findall("collision")
    ]
    return Link(name, mass, com, inertia, tuple(shapes))


def _refuse_limits(reader: XmlReader, limit: ElementTree.Element) -> None:
    # In URDF a continuous joint has no limits. Newton would use limits in the file.
    for key in ("lower", "upper"):
        if limit.get(key) is None:
            continue
        if abs(reader.numbers(limit, key, 1, finite=False)[0]) < UNLIMITED:
            allowed = (
                "none for a continuous joint, so remove lower and upper, or make the "
                "joint revolute"
            )
            raise reader.refused(limit, key, limit.get(key), allowed)


def _read_limits(reader: XmlReader, joint: ElementTree.Element) -> tuple[float, float]:
    limit = joint.find("limit")
    if limit is None:
        return -math.inf, math.inf
    if joint.get("type") == "continuous":
        _refuse_limits(reader, limit)
        return -math.inf, math.inf
    lower = float(reader.numbers(limit, "lower", 1, finite=False)[0])
    upper = float(reader.numbers(limit, "upper", 1, finite=False)[0])
    if lower > upper:
        given, allowed = Fact(f"{lower:g}"), f"at most {upper:g}, the upper limit"
        raise reader.refused(limit, "lower", given, allowed)
    return (
        -math.inf if lower <= -UNLIMITED else lower,
        math.inf if upper >= UNLIMITED else upper,
    )


def read_joint(reader: XmlReader, element: ElementTree.Element) -> Joint:
    """Reads a joint.

    Raises:
        RobotDescriptionError: The joint is malformed, or its kind is not supported.
    """
    name = reader.text(element, "name")
    kind = reader.text(element, "type")
    if kind not in _JOINT_TYPES:
        raise reader.refused(element, "type", kind, listed(_JOINT_TYPES))
    if element.find("mimic") is not None:
        raise reader.error(element, "<mimic> is not supported")
    axis = np.array([1.0, 0.0, 0.0])
    axis_element = element.find("axis")
    if axis_element is not None:
        axis = reader.numbers(axis_element, "xyz", 3)
        if not np.linalg.norm(axis) > 0:
            given = axis_element.get("xyz")
            raise reader.refused(axis_element, "xyz", given, "a direction")
    damping = 0.0
    dynamics = element.find("dynamics")
    if dynamics is not None:
        damping = reader.number(dynamics, "damping", "0")
        if damping < 0:
            given = Fact(f"{damping:g}")
            raise reader.refused(dynamics, "damping", given, "numbers from 0")
        friction = reader.number(dynamics, "friction", "0")
        if friction != 0:
            allowed = "0, as joint friction is not supported"
            raise reader.refused(dynamics, "friction", friction, allowed)
    lower, upper = _read_limits(reader, element)
    return Joint(
        name,
        kind,
        reader.text(reader.child(element, "parent"), "link"),
        reader.text(reader.child(element, "child"), "link"),
        reader.frame(element),
        axis / np.linalg.norm(axis),
        lower,
        upper,
        damping,
    )


def by_name(reader: XmlReader, tag: str) -> dict[str, ElementTree.Element]:
    """Returns the elements with a tag, by name.

    Raises:
        RobotDescriptionError: An element has no name, or two have the same name.
    """
    found: dict[str, ElementTree.Element] = {}
    for element in reader.root.findall(tag):
        name = reader.text(element, "name")
        if name in found:
            raise reader.error(
                element, f"second {tag} of this name; line {reader.lines[found[name]]}"
            )
        found[name] = element
    return found
