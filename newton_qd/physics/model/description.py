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
from newton_qd.errors import warn
from newton_qd.physics.model.degrees import in_degrees
from newton_qd.physics.model.elements import (
    Joint,
    Link,
    Shape,
    by_name,
    check_meshes,
    is_real,
    read_joint,
    read_link,
)
from newton_qd.physics.model.spelling import misspelt
from newton_qd.physics.model.unread import refuse_unread
from newton_qd.physics.model.xml_reader import (
    IDENTITY,
    RobotDescriptionError,
    RobotDescriptionWarning,
    XmlReader,
)
from newton_qd.physics.reference import compose, rotation_matrix

WORLD = "world"
"""Name of a root link that is fixed to the world by its name. Other roots float."""


@dataclasses.dataclass(frozen=True, eq=False)
class Body:
    """A moving link, together with the links that are fixed to it.

    Attributes:
        link: The moving link, with the mass, the centre of mass and the inertia of
            all links of the body. Its frame is the frame of the body.
        joint: The joint that moves it. The joint's frame is in the parent body.
            ``None`` for a body that floats.
        parent: Name of the parent body. ``None`` for the world.
        links: Frames (7,) of all links of the body in that of the body, by name.
        shapes: Colliders of all links of the body, in the body frame.
    """

    link: Link
    joint: Joint | None
    parent: str | None
    links: dict[str, np.ndarray]
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
        unbounded: Names of the revolute joints for which the file gives no bounds.
        doubtful: Texts about names in the file that are almost known ones, and about
            angles that look like degrees.
    """

    path: Path
    name: str
    floating: bool
    bodies: dict[str, Body]
    still: dict[str, np.ndarray]
    fixed: tuple[str, ...]
    unbounded: tuple[str, ...]
    doubtful: tuple[str, ...]


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
    root: Link, links: dict[str, Link], children: dict[str, list[Joint]]
) -> tuple[Link, dict[str, np.ndarray], tuple[Shape, ...], list[Joint]]:
    """Merges a link with all links that are fixed to it.

    Returns:
        The link with the mass and the inertia of all, the frames (7,) of the links by
        name, their colliders, and the moving joints that start at them. All are in the
        frame of ``root``.
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
        frames[link.name] = frame
        shapes += [
            dataclasses.replace(shape, frame=compose(frame, shape.frame))
            for shape in link.shapes
        ]
        pending = [(inner, frame) for inner in children[link.name]] + pending
    merged = _with_masses(root, [(links[name], at) for name, at in frames.items()])
    return merged, frames, tuple(shapes), moving


def _with_masses(root: Link, parts: list[tuple[Link, np.ndarray]]) -> Link:
    """Returns ``root`` with the mass and the inertia of links at frames (7,)."""
    parts = [(link, frame) for link, frame in parts if link.mass > 0]
    if all(link is root for link, _ in parts):
        return root
    mass, com, inertia = merged_inertia(
        [
            (
                link.mass,
                compose(frame, np.append(link.com, IDENTITY[3:]))[:3],
                _turned(link.inertia, frame[3:]),
            )
            for link, frame in parts
        ]
    )
    return dataclasses.replace(root, mass=mass, com=com, inertia=inertia)


def _check_real(merged: Link, parts: list[Link]) -> None:
    """Checks the inertia of a body.

    A link that is no real body alone may be part of one: many files have a sensor of a
    gram with wrong moments, fixed to a trunk.

    Raises:
        RobotDescriptionError: No real body has this inertia. The error names a link.
    """
    for link in parts:
        if link.unreal is not None and not is_real(merged.mass, merged.inertia):
            raise link.unreal


def _turned(inertia: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    rotation = rotation_matrix(quaternion)
    return rotation @ inertia @ rotation.T


def merged_inertia(
    parts: list[tuple[float, np.ndarray, np.ndarray]],
) -> tuple[float, np.ndarray, np.ndarray]:
    """Returns the inertia of rigid bodies that move as one.

    Args:
        parts: Mass [kg], centre of mass (3,) [m] and inertia (3, 3) about it [kg m^2]
            of each body, all in the same axes.

    Returns:
        The same three of all bodies together.
    """
    mass = sum(mass for mass, _, _ in parts)
    com = np.sum([mass * com for mass, com, _ in parts], axis=0) / mass
    total = np.zeros((3, 3))
    for part, centre, inertia in parts:
        arm = centre - com
        total += inertia + part * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return float(mass), com, total


def _check_masses(path: Path, bodies: dict[str, Body]) -> None:
    carried = {name: body.link.mass for name, body in bodies.items()}
    for name, body in reversed(bodies.items()):
        if carried[name] <= 0:
            name = f"{path}: mass of link {name!r} and all that hangs on it"
            allowed = "an <inertial> on it or on a link below it"
            raise RobotDescriptionError(message(name, Fact("none"), allowed))
        if body.parent is not None:
            carried[body.parent] += carried[name]


def _check_floating(path: Path, joint: Joint, fixed: bool) -> None:
    """Checks that a joint of the type floating begins at the origin of the world.

    Its coordinates are then the pose of the link in the world, as those of a root.

    Raises:
        RobotDescriptionError: It does not.
    """
    if not fixed or not np.array_equal(joint.frame, IDENTITY):
        name = f"{path}: joint {joint.name!r} of the type floating, origin"
        given = Fact(
            "frame in a link that moves" if not fixed else joint.frame.tolist()
        )
        allowed = "the parent world, without an origin; reset_pose places the link"
        raise RobotDescriptionError(message(name, given, allowed))


def warn_about(description: Description) -> None:
    """Warns about misspelt names, degrees, and revolute joints without bounds."""
    for text in description.doubtful:
        warn(text, RobotDescriptionWarning)
    if description.unbounded:
        names = listed(description.unbounded)
        name = f"{description.path}: limits of revolute joint(s) {names}"
        allowed = "lower and upper in <limit>, or the type continuous"
        why = "so they turn freely"
        text = message(name, Fact("none"), allowed, why=why)
        warn(text, RobotDescriptionWarning)


def _grown(
    reader: XmlReader,
    root: Link,
    fixed_base: bool,
    links: dict[str, Link],
    children: dict[str, list[Joint]],
) -> tuple[dict[str, Body], dict[str, np.ndarray]]:
    """Returns the bodies, and the places of links that are fixed to the world.

    Args:
        reader: The file.
        root: Root link.
        fixed_base: Whether the root link is fixed to the world.
        links: Links by name.
        children: Joints by the name of their parent link.

    Raises:
        RobotDescriptionError: A link or a floating joint is not supported.
    """
    bodies: dict[str, Body] = {}
    still: dict[str, np.ndarray] = {}
    # a stack: a long chain would be too many calls inside each other
    pending: list[tuple[Link, Joint | None, str | None, bool]]
    pending = [(root, None, None, fixed_base)]
    while pending:
        link, joint, parent, fixed = pending.pop()
        merged, frames, shapes, moving = _merge_fixed(link, links, children)
        if fixed and link.name == WORLD and (link.shapes or link.mass > 0):
            given = Fact("a collider or a mass")
            allowed = "neither on a robot's world link"
            element = by_name(reader, "link")[WORLD]
            raise reader.refused(element, "link", given, allowed)
        if fixed:
            still.update((name, at) for name, at in frames.items() if name != WORLD)
        else:
            _check_real(merged, [links[name] for name in frames])
            bodies[link.name] = Body(merged, joint, parent, frames, shapes)
        holder = None if fixed else link.name
        for next_joint in reversed(moving):
            child = links[next_joint.child]
            if next_joint.kind == "floating":
                _check_floating(reader.path, next_joint, fixed)
                pending.append((child, None, None, False))
            else:
                pending.append((child, next_joint, holder, False))
    return bodies, still


def read_description(path: Path, fixed_base: bool | None = None) -> Description:
    """Reads a URDF file.

    Args:
        path: The file.
        fixed_base: Whether the root link is fixed to the world. ``None``: only a root
            with the name ``world`` is.

    Raises:
        RobotDescriptionError: The file is malformed, or has content that the physics
            does not support. The message names file, line and element.
    """
    reader = XmlReader(path)
    if reader.root.tag != "robot":
        given = Fact(f"<{reader.root.tag}>")
        raise reader.refused(reader.root, "outermost element", given, "<robot>")
    refuse_unread(reader)
    elements = by_name(reader, "link")
    if not elements:
        raise reader.error(reader.root, "element <link> is missing")
    links = {name: read_link(reader, element) for name, element in elements.items()}
    for element in elements.values():
        check_meshes(reader, element)
    children = read_joints(reader, links)
    root = links[find_root(reader, links, children)]
    floating = root.name != WORLD if fixed_base is None else not fixed_base
    bodies, still = _grown(reader, root, not floating, links, children)
    if not bodies:
        raise reader.error(reader.root, "nothing in it moves")
    _check_masses(path, bodies)
    joints = [joint for found in children.values() for joint in found]
    return Description(
        path,
        reader.root.get("name", ""),
        floating,
        bodies,
        still,
        fixed=tuple(joint.name for joint in joints if joint.kind == "fixed"),
        unbounded=tuple(joint.name for joint in joints if not joint.names_bounds),
        doubtful=(*misspelt(reader), *in_degrees(reader)),
    )
