"""Reads a robot's URDF file in double precision, and refuses unsupported content.

:mod:`newton_qd.physics.model.elements` reads the single elements. This module joins
them to one kinematic tree. The reading does not depend on Newton.
:mod:`newton_qd.physics.model.verify` compares it with the model that Newton built.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from newton_qd.checks import Fact, listed, message
from newton_qd.physics.model.elements import (
    Joint,
    Link,
    Shape,
    by_name,
    read_joint,
    read_link,
)
from newton_qd.physics.model.xml_reader import (
    IDENTITY,
    RobotDescriptionError,
    XmlReader,
)
from newton_qd.physics.reference import compose

WORLD = "world"
"""Name of a root link that is fixed to the world. A root with another name floats."""


@dataclasses.dataclass(frozen=True, eq=False)
class Body:
    """A moving link, together with the massless links that are fixed to it.

    Attributes:
        link: The moving link. Its frame is the frame of the body.
        joint: The joint that moves it. The joint's frame is in the parent body.
            ``None`` for a floating root.
        parent: Name of the parent body. ``None`` for the world.
        links: Names of all links of the body.
        shapes: Colliders of all links of the body, in the body frame.
    """

    link: Link
    joint: Joint | None
    parent: str | None
    links: tuple[str, ...]
    shapes: tuple[Shape, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Description:
    """The content of a URDF file.

    Attributes:
        path: The file.
        name: Name of the robot.
        floating: Whether the root link moves freely.
        bodies: Bodies by name, in depth-first order with parents first.
        still: World frames (7,) of the links that are fixed to the world, by name.
        fixed: Names of the fixed joints.
    """

    path: Path
    name: str
    floating: bool
    bodies: dict[str, Body]
    still: dict[str, np.ndarray]
    fixed: tuple[str, ...]


def read_joints(reader: XmlReader, links: dict[str, Link]) -> dict[str, list[Joint]]:
    """Reads and checks the joints, and returns them by parent link.

    Raises:
        RobotDescriptionError: A joint is malformed or its kind is not supported. Or it
            names a link that does not exist, or a child link that already has a parent.
    """
    children: dict[str, list[Joint]] = {name: [] for name in links}
    moved: set[str] = set()
    for element in by_name(reader, "joint").values():
        joint = read_joint(reader, element)
        for role, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in links:
                raise reader.refused(element, role, link, listed(links))
        if joint.child in moved:
            raise reader.error(element, f"link {joint.child!r} already has a parent")
        moved.add(joint.child)
        children[joint.parent].append(joint)
    return children


def find_root(
    reader: XmlReader, links: dict[str, Link], children: dict[str, list[Joint]]
) -> str:
    """Returns the link without a parent, after a check that the links form one tree.

    Raises:
        RobotDescriptionError: Several links have no parent, or links form a loop.
    """
    moved = {joint.child for joints in children.values() for joint in joints}
    roots = [name for name in links if name not in moved]
    if len(roots) != 1:
        given = Fact(f"{len(roots)} without a parent ({listed(roots, 'a loop')})")
        raise reader.refused(reader.root, "links", given, "one tree")
    reached = [roots[0]]
    for link in reached:
        reached += [joint.child for joint in children[link]]
    if len(reached) != len(links):
        loop = ", ".join(name for name in links if name not in reached)
        given = Fact(f"a loop ({loop})")
        raise reader.refused(reader.root, "links", given, "one tree")
    return roots[0]


def _merge_fixed(
    reader: XmlReader,
    root: Link,
    links: dict[str, Link],
    children: dict[str, list[Joint]],
) -> tuple[dict[str, np.ndarray], tuple[Shape, ...], list[Joint]]:
    """Merges a link with all links that are fixed to it.

    Returns:
        Frames (7,) of the links by name, their colliders, and the moving joints that
        start at them. All are in the frame of ``root``.

    Raises:
        RobotDescriptionError: A fixed link has mass.
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
            # When Newton 1.8 merges links, it ignores the offset of the centre of mass.
            name = f"{reader.path}: mass of link {link.name!r}"
            given = Fact(f"{link.mass:g}")
            why = f"and it is fixed to {joint.parent!r}"
            allowed = f"0, so give the mass of both to {joint.parent!r}"
            raise RobotDescriptionError(message(name, given, allowed, why=why))
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
            name = f"{path}: mass of link {name!r} and all that hangs on it"
            allowed = "an <inertial> on it or on a link below it"
            raise RobotDescriptionError(message(name, Fact("none"), allowed))
        if body.parent is not None:
            carried[body.parent] += carried[name]


def read_description(path: Path) -> Description:
    """Reads a URDF file.

    Raises:
        RobotDescriptionError: The file is malformed, or has content that the physics
            does not support. The message names file, line and element.
    """
    reader = XmlReader(path)
    if reader.root.tag != "robot":
        given = Fact(f"<{reader.root.tag}>")
        raise reader.refused(reader.root, "outermost element", given, "<robot>")
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
            given = Fact("a collider or a mass")
            allowed = "neither on a robot's world link"
            raise reader.refused(elements[WORLD], "link", given, allowed)
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
    joints = [joint for found in children.values() for joint in found]
    fixed = tuple(joint.name for joint in joints if joint.kind == "fixed")
    name = reader.root.get("name", "")
    return Description(path, name, floating, bodies, still, fixed)
