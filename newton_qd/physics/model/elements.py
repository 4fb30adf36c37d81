"""Reads the elements of a URDF file: colliders, links and joints.

Elements that the physics does not need are ignored: materials, transmissions and
simulator extensions. Unsupported content is an error.
"""

from __future__ import annotations

import dataclasses
import math
from xml.etree import ElementTree

import numpy as np

from newton_qd.checks import Fact, listed, message
from newton_qd.physics.model.mesh_files import places
from newton_qd.physics.model.xml_reader import RobotDescriptionError, XmlReader
from newton_qd.physics.reference import rotation_matrix

UNLIMITED = 1e9
"""A limit of this size or larger means no limit. Newton writes 1e10 [rad or m]."""

# A body of this size is a point [m].
_POINT = 1e-9

_JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating")
WITHOUT_AXIS = ("fixed", "floating")
"""Types of a joint that have no axis."""
_SHORTEST = 1e-6  # of an axis: Newton divides by its length in single precision
# Attributes that a shape must have. Newton uses 1 for a missing size.
_SHAPES = {
    "sphere": ("radius",),
    "capsule": ("radius", "length"),
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
    names_bounds: bool = True
    """Whether the file gives bounds, or says by the type that there are none."""


@dataclasses.dataclass(frozen=True, eq=False)
class Link:
    """A link: ``com`` (3,) [m], ``inertia`` (3, 3) about it in link axes [kg m^2].

    No real body alone has its inertia if ``unreal`` is an error.
    """

    name: str
    mass: float
    com: np.ndarray
    inertia: np.ndarray
    shapes: tuple[Shape, ...]
    unreal: RobotDescriptionError | None = None


def is_real(mass: float, inertia: np.ndarray) -> bool:
    """Returns whether a rigid body can have this inertia (3, 3) about its centre.

    Each principal moment is at most the sum of the other two. A rod has a moment of 0,
    and a point has no other. Rounding may make it negative.
    """
    moments = np.linalg.eigvalsh(inertia)
    least = -1e-9 * moments[2] - _POINT**2 * mass
    largest = (moments[0] + moments[1]) * (1 + 1e-6) - least
    return bool(moments[0] >= least and moments[2] <= largest)


def _read_shape(
    reader: XmlReader, element: ElementTree.Element, link: str, *, drawn: bool = False
) -> Shape:
    """Returns a collider, or with ``drawn`` a visual. A visual may have a size of 0."""
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
        size[:] = reader.positive(shape, "size", 3, or_zero=drawn) / 2
    else:
        size[0] = reader.positive(shape, "radius", 1, or_zero=drawn)[0]
        if shape.tag != "sphere":
            size[1] = _straight_length(reader, shape, or_zero=drawn) / 2
    return Shape(link, shape.tag, reader.frame(element), size, element.get("name", ""))


def _straight_length(
    reader: XmlReader, shape: ElementTree.Element, *, or_zero: bool
) -> float:
    """Returns the length of a cylinder, or of a capsule without its caps [m]."""
    keys = ["length"]
    if shape.tag == "capsule" and shape.get("height") is not None:
        # Newton reads the height of a capsule. ROS, MuJoCo and Bullet read its length.
        keys = ["height"] if shape.get("length") is None else ["height", "length"]
    lengths = [
        float(reader.positive(shape, key, 1, or_zero=or_zero)[0]) for key in keys
    ]
    if lengths[0] != lengths[-1]:
        given = tuple(shape.get(key) for key in keys)
        allowed = "two equal numbers, as both mean the straight part"
        raise reader.refused(shape, ", ".join(keys), given, allowed)
    return lengths[0]


def read_link(reader: XmlReader, element: ElementTree.Element) -> Link:
    """Reads a link: its inertia and its colliders.

    Raises:
        RobotDescriptionError: The link is malformed.
    """
    name = reader.text(element, "name")
    link = _read_inertial(reader, element, name)
    for visual in element.findall("visual"):
        _read_shape(reader, visual, name, drawn=True)
    shapes = [
        _read_shape(reader, collision, name)
        for collision in element.findall("collision")
    ]
    return dataclasses.replace(link, shapes=tuple(shapes))


def _read_inertial(reader: XmlReader, link: ElementTree.Element, name: str) -> Link:
    """Returns a link with the mass, the centre and the inertia of the element."""
    found = link.findall("inertial")
    if len(found) > 1:
        raise reader.error(found[1], "second <inertial> of this link")
    if not found:
        return Link(name, 0.0, np.zeros(3), np.zeros((3, 3)), ())
    inertial = found[0]
    mass_element = reader.child(inertial, "mass")
    element = reader.child(inertial, "inertia")
    inertia = np.empty((3, 3))
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        key = "i" + "xyz"[i] + "xyz"[j]
        inertia[i, j] = inertia[j, i] = reader.number(element, key)
    frame = reader.frame(inertial)
    com = frame[:3]
    if reader.number(mass_element, "value") == 0 and not inertia.any():
        # a link without mass, written as zeros
        return Link(name, 0.0, com, inertia, ())
    mass = float(reader.positive(mass_element, "value", 1)[0])
    unreal = None
    if not is_real(mass, inertia):
        moments = np.linalg.eigvalsh(inertia)
        given = Fact(listed([f"{moment:g}" for moment in moments]))
        allowed = "numbers from 0, none larger than the sum of the other two"
        unreal = reader.refused(element, "principal moments", given, allowed)
    rotation = rotation_matrix(frame[3:])
    return Link(name, mass, com, rotation @ inertia @ rotation.T, (), unreal)


def check_meshes(reader: XmlReader, link: ElementTree.Element) -> None:
    """Checks that the meshes of a link's colliders are files on this machine.

    Raises:
        RobotDescriptionError: One is not, so a viewer or Newton cannot read it.
    """
    for mesh in link.iterfind("collision/geometry/mesh"):
        filename = reader.text(mesh, "filename")
        if not any(place.is_file() for place in places(reader.path, filename)):
            why = "which is no file on this machine; contacts do not support a mesh"
            allowed = (
                "sphere or capsule, or box, cylinder or the file of a mesh where "
                "nothing touches"
            )
            name = f"link {link.get('name')!r} has a mesh as collider, filename"
            raise reader.error(mesh, message(name, filename, allowed, why=why))


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


def _read_limits(
    reader: XmlReader, joint: ElementTree.Element
) -> tuple[float, float] | None:
    """Returns the lower and the upper limit; ``None`` if the file gives neither."""
    limit = joint.find("limit")
    if joint.get("type") == "continuous" and limit is not None:
        _refuse_limits(reader, limit)
        return None
    if limit is None or (limit.get("lower") is None and limit.get("upper") is None):
        return None
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
        cure = "make the joint fixed, or remove <mimic> to let it move alone"
        raise reader.error(element, f"<mimic> is not supported; {cure}")
    parent = reader.text(reader.child(element, "parent"), "link")
    child = reader.text(reader.child(element, "child"), "link")
    frame = reader.frame(element)
    axis, damping, limits = np.array([1.0, 0.0, 0.0]), 0.0, None
    if kind not in WITHOUT_AXIS:  # what such a joint says of an axis has no meaning
        axis, damping = _read_axis(reader, element), _read_damping(reader, element)
        limits = _read_limits(reader, element)
    lower, upper = limits or (-math.inf, math.inf)
    given = limits is not None or kind != "revolute"
    return Joint(name, kind, parent, child, frame, axis, lower, upper, damping, given)


def _read_axis(reader: XmlReader, joint: ElementTree.Element) -> np.ndarray:
    element = joint.find("axis")
    if element is None:
        return np.array([1.0, 0.0, 0.0])
    axis = reader.numbers(element, "xyz", 3)
    if not np.linalg.norm(axis) > _SHORTEST:
        allowed = f"a direction, longer than {_SHORTEST:g}"
        raise reader.refused(element, "xyz", element.get("xyz"), allowed)
    return axis / np.linalg.norm(axis)


def _read_damping(reader: XmlReader, joint: ElementTree.Element) -> float:
    dynamics = joint.find("dynamics")
    if dynamics is None:
        return 0.0
    damping = reader.number(dynamics, "damping", "0")
    if damping < 0:
        given = Fact(f"{damping:g}")
        raise reader.refused(dynamics, "damping", given, "numbers from 0")
    friction = reader.number(dynamics, "friction", "0")
    if friction != 0:
        allowed = "0, as joint friction is not supported"
        raise reader.refused(dynamics, "friction", friction, allowed)
    return damping


def by_name(reader: XmlReader, tag: str) -> dict[str, ElementTree.Element]:
    """Returns the elements with a tag, by name.

    Raises:
        RobotDescriptionError: An element has no name, two have the same name, or one
            has an apostrophe in it.
    """
    found: dict[str, ElementTree.Element] = {}
    for element in reader.root.findall(tag):
        name = reader.text(element, "name")
        if "'" in name:  # Newton looks names up with a path in which it ends a name
            allowed = "text without an apostrophe"
            raise reader.refused(element, "name", name, allowed)
        if name in found:
            raise reader.error(
                element, f"second {tag} of this name; line {reader.lines[found[name]]}"
            )
        found[name] = element
    return found
