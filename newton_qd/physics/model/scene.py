"""Reads the static obstacles of a scene, and finds the contacts with them."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator

import numpy as np

from newton_qd import checks
from newton_qd.assets import find_urdf
from newton_qd.checks import Fact, listed, message
from newton_qd.errors import warn
from newton_qd.physics import reference
from newton_qd.physics.model.description import WORLD, find_root, read_joints
from newton_qd.physics.model.elements import Link, Shape, by_name, read_link
from newton_qd.physics.model.spelling import misspelt
from newton_qd.physics.model.unread import refuse_unread
from newton_qd.physics.model.xml_reader import (
    IDENTITY,
    RobotDescriptionError,
    RobotDescriptionWarning,
    XmlReader,
)
from newton_qd.physics.system import ObstacleKind
from newton_qd.robots import RobotSpec
from newton_qd.scenes import Scene

# A sphere is a capsule with length 0.
_KINDS = {
    "sphere": ObstacleKind.CAPSULE,
    "capsule": ObstacleKind.CAPSULE,
    "box": ObstacleKind.BOX,
}
# Kinds of colliders of a robot that may touch an obstacle or each other.
TOUCHING = ("sphere", "capsule")


@dataclasses.dataclass(frozen=True, eq=False)
class SceneLink:
    """A static link: its name, its world ``frame`` (7,) and its colliders.

    The frames of the colliders are in the world, too.
    """

    name: str
    frame: np.ndarray
    shapes: tuple[Shape, ...]


@dataclasses.dataclass(frozen=True)
class ContactRow:
    """One contact: a sphere or capsule of a body, and an obstacle.

    Attributes:
        body: Index of the robot's body.
        obstacle: Row of the obstacle tables, -1 for a side of a pair.
        position: (3,) centre in the body frame [m].
        segment: (3,) vector from the centre to an end of a capsule's axis, in the body
            frame [m].
        radius: Radius [m].
    """

    body: int
    obstacle: int
    position: np.ndarray
    segment: np.ndarray
    radius: float


def read_scene(scene: Scene) -> tuple[SceneLink, ...]:
    """Reads the links of a scene, in the order of its file.

    A root link with the name ``world`` is the world. It is not part of the result.

    Raises:
        TypeError: ``scene`` is not a ``Scene``.
        AssetNotFoundError: The URDF file does not exist.
        RobotDescriptionError: The file is malformed, a link moves or has mass, or the
            kind of a collider is not supported.
    """
    allowed = "None, or a Scene such as newton_qd.scenes.TRAP"
    checks.instance("scene", scene, Scene, allowed)
    reader = XmlReader(find_urdf(scene.urdf))
    if reader.root.tag != "robot":
        given = Fact(f"<{reader.root.tag}>")
        raise reader.refused(reader.root, "outermost element", given, "<robot>")
    refuse_unread(reader)
    elements = by_name(reader, "link")
    if not elements:
        raise reader.error(reader.root, "element <link> is missing")
    for text in misspelt(reader):
        warn(text, RobotDescriptionWarning)
    links = {name: read_link(reader, element) for name, element in elements.items()}
    for name, link in links.items():
        if (name == WORLD and link.shapes) or link.mass > 0:
            what = "mass" if link.mass > 0 else "collider"
            raise reader.refused(elements[name], what, Fact("one"), "none in a scene")
        for shape in link.shapes:
            if shape.kind not in _KINDS:
                given = Fact(shape.kind)
                raise reader.refused(elements[name], "collider", given, listed(_KINDS))
    frames = _link_frames(reader, links)
    if not any(link.shapes for link in links.values()):
        text = f"{reader.path}: no link has a collider, so nothing touches the scene"
        warn(text, RobotDescriptionWarning)
    return tuple(
        SceneLink(name, frames[name], _placed(links[name], frames[name]))
        for name in links
        if name != WORLD
    )


def _link_frames(reader: XmlReader, links: dict[str, Link]) -> dict[str, np.ndarray]:
    """Returns the frame (7,) of every link in the world.

    Raises:
        RobotDescriptionError: A joint is not fixed.
    """
    children = read_joints(reader, links)
    root = find_root(reader, links, children)
    frames = {root: IDENTITY}
    pending = [root]
    for parent in pending:
        for joint in children[parent]:
            if joint.kind != "fixed":
                name = f"{reader.path}: type of joint {joint.name!r}"
                raise RobotDescriptionError(
                    message(name, joint.kind, "fixed joints in a scene")
                )
            frames[joint.child] = reference.compose(frames[parent], joint.frame)
            pending.append(joint.child)
    return frames


def _placed(link: Link, frame: np.ndarray) -> tuple[Shape, ...]:
    return tuple(
        dataclasses.replace(shape, frame=reference.compose(frame, shape.frame))
        for shape in link.shapes
    )


def obstacle_tables(links: tuple[SceneLink, ...]) -> dict[str, np.ndarray]:
    """Returns the obstacle tables: the ground in row 0, then the walls."""
    shapes = [shape for link in links for shape in link.shapes]
    kinds = [ObstacleKind.PLANE, *(_KINDS[shape.kind] for shape in shapes)]
    return {
        "obstacle_kind": np.array(kinds, dtype=np.int32),
        "obstacle_frame": np.array([IDENTITY, *(shape.frame for shape in shapes)]),
        "obstacle_size": np.array([np.zeros(3), *(shape.size for shape in shapes)]),
    }


def whole_collider(body: int, obstacle: int, shape: Shape) -> ContactRow:
    """Returns the contact of a sphere or a whole capsule with an obstacle."""
    axis = reference.rotation_matrix(shape.frame[3:])[:, 2]
    half = shape.size[1] * axis
    return ContactRow(body, obstacle, shape.frame[:3], half, float(shape.size[0]))


def check_scene(scene: Scene | None) -> None:
    """Checks the types of a scene's fields.

    Raises:
        TypeError: ``scene`` is not a ``Scene``.
        RobotDescriptionError: A field has the wrong type.
    """
    if scene is None:
        return
    allowed = "None, or a Scene such as newton_qd.scenes.TRAP"
    checks.instance("scene", scene, Scene, allowed)
    checks.text("scene, name", scene.name, error=RobotDescriptionError)
    field = f"scene {scene.name!r}"
    if not isinstance(scene.urdf, (str, os.PathLike)):
        allowed = 'a path, such as "walls.urdf"'
        raise RobotDescriptionError(message(f"{field}, urdf", scene.urdf, allowed))
    names = scene.links
    if names is not None and (
        # a string is a sequence too: it would be read as one name per letter
        not isinstance(names, tuple) or not all(isinstance(name, str) for name in names)
    ):
        allowed = 'None, a tuple of names of links, such as ("foot",)'
        raise RobotDescriptionError(message(f"{field}, links", names, allowed))
    if names is not None and len(set(names)) < len(names):
        raise RobotDescriptionError(message(f"{field}, links", names, "each once"))


def wall_contacts(
    robot: RobotSpec,
    scene: Scene,
    obstacles: int,
    colliders: dict[str, tuple[int, tuple[Shape, ...]]],
) -> Iterator[ContactRow]:
    """Yields the contacts of the robot's links with every wall.

    The links are those of the scene's field ``links``. If it is ``None``, they are the
    links with a ground contact.

    Args:
        robot: The robot.
        scene: The scene.
        obstacles: Number of rows of the obstacle tables. Row 0 is the ground.
        colliders: For each link of the robot: index of its body, and its colliders in
            the body frame.

    Raises:
        RobotDescriptionError: ``links`` is ``None``, and the robot has no ground
            contact. Or a link is not a link of the robot, or it has no collider, or one
            of a kind that may not touch.
    """
    names = scene.links
    if names is None:
        names = tuple(dict.fromkeys(contact.link for contact in robot.contacts))
    if scene.links is None and not names and obstacles > 1:
        field = f"scene {scene.name!r}, links"
        why = f"and robot {robot.name!r} has no contact with the ground"
        allowed = f"links that touch the walls, of {listed(colliders)}; or (): none"
        raise RobotDescriptionError(message(field, scene.links, allowed, why=why))
    for name in names:
        if name not in colliders:
            field, why = f"scene {scene.name!r}, links", f"which is not in {robot.urdf}"
            raise RobotDescriptionError(
                message(field, name, listed(colliders), why=why)
            )
        body, shapes = colliders[name]
        if not shapes or any(shape.kind not in TOUCHING for shape in shapes):
            field = f"scene {scene.name!r}, links: colliders of {name!r}"
            found = Fact(listed([shape.kind for shape in shapes]))
            allowed = f"at least one, each of {listed(TOUCHING)}"
            if scene.links is None:
                allowed += "; Scene(links=(...)) names other links"
            raise RobotDescriptionError(message(field, found, allowed))
        for shape in shapes:
            for obstacle in range(1, obstacles):
                yield whole_collider(body, obstacle, shape)
