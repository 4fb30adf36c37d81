"""Reads a robot's URDF file in double precision, and refuses what it cannot mean.

This is the independent reading that :mod:`newton_qd.physics.model.verify` holds against
the model that Newton built. Elements that physics does not need (materials,
transmissions, simulator extensions) are ignored.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from newton_qd.physics.model.xml_reader import (
    IDENTITY,
    RobotDescriptionError,
    XmlReader,
)
from newton_qd.physics.reference import compose, rotation_matrix

WORLD = "world"
"""Name of a root link that is fixed to the world; any other root floats."""

UNLIMITED = 1e9
"""Limits beyond this are none; Newton writes 1e10 [rad or m]."""

_JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed")
# Sizes that a shape needs; Newton takes 1 for one that is missing.
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
        link: Link that names it in the file.
        kind: Tag of its geometry, such as ``"capsule"``.
        frame: (7,) position [m] and quaternion xyzw in the body.
        size: (3,) as Newton stores it: sphere: radius; capsule and cylinder:
            radius, half of the straight part; box: half extents [m].
        name: Name of the collider in the file; empty if it has none.
    """

    link: str
    kind: str
    frame: np.ndarray
    size: np.ndarray
    name: str = ""


@dataclasses.dataclass(frozen=True, eq=False)
class Joint:
    """A joint; ``frame`` (7,) is in the parent link, ``axis`` (3,) in the joint."""

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
    """A link: ``com`` (3,) [m]; ``inertia`` (3, 3) about it, link axes [kg m^2]."""

    name: str
    mass: float
    com: np.ndarray
    inertia: np.ndarray
    shapes: tuple[Shape, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Body:
    """A link that moves, with the massless links that are fixed to it.

    Attributes:
        link: The link; its frame is the body's.
        joint: The joint that moves it, its frame in the parent body; ``None``
            for a floating root.
        parent: Name of the parent body; ``None`` for the world.
        links: Names of the links of the body.
        shapes: Colliders of all of them, in the body.
    """

    link: Link
    joint: Joint | None
    parent: str | None
    links: tuple[str, ...]
    shapes: tuple[Shape, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Description:
    """A URDF file.

    Attributes:
        path: The file.
        name: Name of the robot.
        floating: Whether the root link moves freely.
        bodies: By name, parents first, in depth-first order.
        still: Frames (7,) in the world of the links that are fixed to it.
    """

    path: Path
    name: str
    floating: bool
    bodies: dict[str, Body]
    still: dict[str, np.ndarray]


def _read_shape(reader: XmlReader, element: ElementTree.Element, link: str) -> Shape:
    geometry = reader.child(element, "geometry")
    kinds = [child for child in geometry if child.tag in _SHAPES]
    if len(kinds) != 1 or len(geometry) != 1:
        found = ", ".join(child.tag for child in geometry) or "nothing"
        raise reader.error(
            geometry, f"holds {found}; allowed: exactly one of {', '.join(_SHAPES)}"
        )
    shape = kinds[0]
    size = np.zeros(3)
    if shape.tag == "mesh":
        reader.text(shape, "filename")
    elif shape.tag == "box":
        size[:] = reader.positive(shape, "size", 3) / 2
    else:
        for i, key in enumerate(_SHAPES[shape.tag]):
            size[i] = reader.positive(shape, key, 1)[0] / (1 if i == 0 else 2)
    # Newton reads a capsule's height, MuJoCo its length.
    if shape.tag == "capsule" and shape.get("length") is not None:
        if 2 * size[1] != reader.number(shape, "length"):
            raise reader.error(
                shape,
                f"height={shape.get('height')!r} and length={shape.get('length')!r} "
                "both mean the straight part and must be equal",
            )
    return Shape(link, shape.tag, reader.frame(element), size, element.get("name", ""))


def _read_inertial(
    reader: XmlReader, link: ElementTree.Element
) -> tuple[float, np.ndarray, np.ndarray]:
    """Returns mass, centre of mass (3,) and inertia (3, 3) about it, link axes."""
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
    # A principal moment is at most the sum of the others for any real body.
    if moments[0] <= 0 or moments[2] > (moments[0] + moments[1]) * (1 + 1e-6):
        raise reader.error(
            element,
            f"principal moments {', '.join(f'{m:g}' for m in moments)}; allowed: "
            "positive, none larger than the sum of the other two",
        )
    frame = reader.frame(inertial)
    rotation = rotation_matrix(frame[3:])
    return float(mass), frame[:3], rotation @ inertia @ rotation.T


def read_link(reader: XmlReader, element: ElementTree.Element) -> Link:
    """Reads a link: its inertia and its colliders."""
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
    # URDF gives a continuous joint no limits, and Newton takes those that are written.
    for key in ("lower", "upper"):
        if limit.get(key) is None:
            continue
        if abs(reader.numbers(limit, key, 1, finite=False)[0]) < UNLIMITED:
            raise reader.error(
                limit,
                f"{key}={limit.get(key)!r} of a continuous joint; allowed: none, so "
                "remove lower and upper, or make the joint revolute",
            )


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
        raise reader.error(limit, f"lower {lower:g} is above upper {upper:g}")
    return (
        -math.inf if lower <= -UNLIMITED else lower,
        math.inf if upper >= UNLIMITED else upper,
    )


def _read_joint(reader: XmlReader, element: ElementTree.Element) -> Joint:
    name = reader.text(element, "name")
    kind = reader.text(element, "type")
    if kind not in _JOINT_TYPES:
        raise reader.error(
            element, f"type={kind!r} not supported; allowed: {', '.join(_JOINT_TYPES)}"
        )
    if element.find("mimic") is not None:
        raise reader.error(element, "<mimic> is not supported")
    axis = np.array([1.0, 0.0, 0.0])
    axis_element = element.find("axis")
    if axis_element is not None:
        axis = reader.numbers(axis_element, "xyz", 3)
        if not np.linalg.norm(axis) > 0:
            raise reader.error(axis_element, "xyz is zero; allowed: a direction")
    damping = 0.0
    dynamics = element.find("dynamics")
    if dynamics is not None:
        damping = reader.number(dynamics, "damping", "0")
        if damping < 0:
            raise reader.error(dynamics, f"damping={damping:g}; allowed: not negative")
        if reader.number(dynamics, "friction", "0") != 0:
            raise reader.error(dynamics, "joint friction is not supported; allowed: 0")
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
    """Returns the elements of a tag by their names, each given once."""
    found: dict[str, ElementTree.Element] = {}
    for element in reader.root.findall(tag):
        name = reader.text(element, "name")
        if name in found:
            raise reader.error(
                element, f"second {tag} of this name; line {reader.lines[found[name]]}"
            )
        found[name] = element
    return found


def read_joints(reader: XmlReader, links: dict[str, Link]) -> dict[str, list[Joint]]:
    """Returns the joints by parent link, having checked that they name links."""
    children: dict[str, list[Joint]] = {name: [] for name in links}
    moved: set[str] = set()
    for element in by_name(reader, "joint").values():
        joint = _read_joint(reader, element)
        for role, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in links:
                raise reader.error(
                    element, f"{role} {link!r} unknown; links: {', '.join(links)}"
                )
        if joint.child in moved:
            raise reader.error(element, f"link {joint.child!r} already has a parent")
        moved.add(joint.child)
        children[joint.parent].append(joint)
    return children


def find_root(
    reader: XmlReader, links: dict[str, Link], children: dict[str, list[Joint]]
) -> str:
    """Returns the link without a parent, having checked that there is one tree."""
    moved = {joint.child for joints in children.values() for joint in joints}
    roots = [name for name in links if name not in moved]
    if len(roots) != 1:
        raise reader.error(
            reader.root,
            f"{len(roots)} links without a parent ({', '.join(roots) or 'a loop'}); "
            "allowed: one tree",
        )
    reached = [roots[0]]
    for link in reached:
        reached += [joint.child for joint in children[link]]
    if len(reached) != len(links):
        loop = ", ".join(name for name in links if name not in reached)
        raise reader.error(reader.root, f"links in a loop: {loop}; allowed: one tree")
    return roots[0]


def _merge_fixed(
    reader: XmlReader,
    root: Link,
    links: dict[str, Link],
    children: dict[str, list[Joint]],
) -> tuple[dict[str, np.ndarray], tuple[Shape, ...], list[Joint]]:
    """Gathers what is fixed to a link.

    Returns:
        Frames (7,) of the links by name, their colliders, and the moving joints on
        them, all in the frame of ``root``.
    """
    frames, shapes, moving = {root.name: IDENTITY}, list(root.shapes), []
    pending = [(joint, IDENTITY) for joint in children[root.name]]
    while pending:
        joint, outer = pending.pop(0)
        frame = compose(outer, joint.frame)
        if joint.kind != "fixed":
            moving.append(dataclasses.replace(joint, frame=frame))
            continue
        link = links[joint.child]
        if link.mass > 0:
            # Newton 1.8 forgets the offset of the centre of mass when it merges.
            raise RobotDescriptionError(
                f"{reader.path}: link {link.name!r} has mass and is fixed to "
                f"{joint.parent!r}; allowed: give the mass of both to {joint.parent!r}"
            )
        frames[link.name] = frame
        shapes += [
            dataclasses.replace(shape, frame=compose(frame, shape.frame))
            for shape in link.shapes
        ]
        pending = [(inner, frame) for inner in children[link.name]] + pending
    return frames, tuple(shapes), moving


def _check_masses(path: Path, bodies: dict[str, Body]) -> None:
    carried = {name: body.link.mass for name, body in bodies.items()}
    for name, body in reversed(bodies.items()):
        if carried[name] <= 0:
            raise RobotDescriptionError(
                f"{path}: link {name!r} and all that hangs on it have no mass; "
                "allowed: an <inertial> on it or on a link below it"
            )
        if body.parent is not None:
            carried[body.parent] += carried[name]


def read_description(path: Path) -> Description:
    """Reads a URDF file.

    Raises:
        RobotDescriptionError: The file is malformed, or describes something that
            the physics does not have. Names file, line and element.
    """
    reader = XmlReader(path)
    if reader.root.tag != "robot":
        raise reader.error(reader.root, "allowed as the outermost element: <robot>")
    elements = by_name(reader, "link")
    if not elements:
        raise reader.error(reader.root, "element <link> is missing")
    links = {name: read_link(reader, element) for name, element in elements.items()}
    children = read_joints(reader, links)
    root = links[find_root(reader, links, children)]
    floating = root.name != WORLD
    bodies: dict[str, Body] = {}
    still: dict[str, np.ndarray] = {}

    def grow(link: Link, joint: Joint | None, parent: str | None) -> None:
        frames, shapes, moving = _merge_fixed(reader, link, links, children)
        fixed = joint is None and not floating
        if fixed and (link.shapes or link.mass > 0):
            raise reader.error(
                elements[WORLD],
                "a robot's world link has a collider or a mass; allowed: neither",
            )
        if fixed:
            still.update((name, at) for name, at in frames.items() if name != WORLD)
        else:
            bodies[link.name] = Body(link, joint, parent, tuple(frames), shapes)
        for next_joint in moving:
            grow(links[next_joint.child], next_joint, None if fixed else link.name)

    grow(root, None, None)
    if not bodies:
        raise reader.error(reader.root, "nothing in it moves")
    _check_masses(path, bodies)
    return Description(path, reader.root.get("name", ""), floating, bodies, still)
