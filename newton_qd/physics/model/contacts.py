"""Builds the contact tables: contacts with the ground, with walls and of link pairs."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from newton_qd.checks import Fact, listed
from newton_qd.physics import reference
from newton_qd.physics.model.description import Body
from newton_qd.physics.model.elements import Shape
from newton_qd.physics.model.named_links import body_of
from newton_qd.physics.model.robot_checks import check_feet, refusal
from newton_qd.physics.model.scene import (
    TOUCHING,
    ContactRow,
    wall_contacts,
    whole_collider,
)
from newton_qd.robots import Contact, RobotSpec
from newton_qd.scenes import Scene

_CORNERS = np.array([*itertools.product((-1.0, 1.0), repeat=3)])


def _contact_spheres(shape: Shape, end: int) -> tuple[np.ndarray, float]:
    """Returns the spheres with which a collider touches the ground.

    The lowest point of a box is always a corner, so the corners are its spheres, with a
    radius of 0.

    Returns:
        Centres (n, 3) in the body frame [m], and radius [m].
    """
    turn = reference.rotation_matrix(shape.frame[3:])
    if shape.kind == "box":
        return shape.frame[:3] + _CORNERS * shape.size @ turn.T, 0.0
    half_length = shape.size[1] if end else 0.0
    centre = shape.frame[:3] + end * half_length * turn[:, 2]
    return centre[None], float(shape.size[0])


def _colliders(contact: Contact, body: Body, kinds: tuple[str, ...]) -> list[Shape]:
    """Returns the colliders of the given kinds that a contact of the robot names."""
    return [
        shape
        for shape in body.shapes
        if shape.link == contact.link
        and shape.kind in kinds
        and contact.collider in (None, shape.name)
    ]


def _collider(robot: RobotSpec, contact: Contact, body: Body) -> Shape:
    """Returns the only collider of a body that matches a contact of the robot."""
    kind = "capsule" if contact.end else "sphere"
    found = _colliders(contact, body, (kind,))
    if not found and not contact.end:
        found = _colliders(contact, body, ("box",))
    if len(found) != 1:
        named = "" if contact.collider is None else f" named {contact.collider!r}"
        kinds = [
            f"{each.kind} {each.name!r}" if each.name else each.kind
            for each in body.shapes
            if each.link == contact.link
        ]
        raise refusal(
            robot,
            f"contacts: end of {contact.link!r}",
            contact.end,
            "exactly one, with end 0 for a sphere or a box, 1 or -1 for a capsule, and "
            "its name in the file where there are several",
            why=f"which needs a {kind} collider{named}; the link has {listed(kinds)}",
        )
    return found[0]


def _ground_contacts(robot: RobotSpec, bodies: list[Body]) -> Iterator[ContactRow]:
    """Yields the contacts of the robot's spheres and boxes with the ground."""
    # A contact may name its collider or leave the name out. Both can mean the same one.
    seen: set[tuple[int, int]] = set()
    for contact in robot.contacts:
        body = body_of(robot, "contacts", contact.link, bodies)
        shape = _collider(robot, contact, bodies[body])
        if (id(shape), contact.end) in seen:
            given = Fact(f"{contact.end} twice")
            field = f"contacts: end of {contact.link!r}"
            raise refusal(robot, field, given, "each once")
        seen.add((id(shape), contact.end))
        centres, radius = _contact_spheres(shape, contact.end)
        for centre in centres:
            yield ContactRow(body, 0, centre, np.zeros(3), radius)


def _pair_sides(
    robot: RobotSpec, bodies: list[Body]
) -> Iterator[tuple[ContactRow, ContactRow]]:
    """Yields both sides of each pair of the robot, the shorter side first."""
    # A side may name its collider or leave the name out. Both can mean the same one.
    seen: set[frozenset[int]] = set()
    for pair in robot.pairs:
        sides, shapes = [], []
        for contact in pair:
            body = body_of(robot, "pairs", contact.link, bodies)
            found = _colliders(contact, bodies[body], TOUCHING)
            if len(found) != 1:
                named = "" if contact.collider is None else f" {contact.collider!r}"
                allowed = "exactly one, with its name in the file if there are several"
                count = f"a link with {len(found)} colliders{named}"
                why = f"{count} of {listed(TOUCHING)}"
                raise refusal(robot, "pairs", contact.link, allowed, why=why)
            sides.append(whole_collider(body, -1, found[0]))
            shapes.append(id(found[0]))
        first, second = sides
        if first.body == second.body:
            given = Fact(f"{pair[0].link!r} and {pair[1].link!r}")
            allowed = "links with a joint between them"
            raise refusal(robot, "pairs", given, allowed, why="which move as one body")
        if frozenset(shapes) in seen:
            given = Fact(f"{pair[0].link!r} and {pair[1].link!r} twice")
            raise refusal(robot, "pairs", given, "each once")
        seen.add(frozenset(shapes))
        # The nearest point of a segment to a sphere is exact. The shorter side is
        # therefore first.
        swap = np.linalg.norm(first.segment) > np.linalg.norm(second.segment)
        yield (second, first) if swap else (first, second)


def contact_tables(
    robot: RobotSpec, scene: Scene | None, bodies: list[Body], obstacles: int
) -> dict[str, np.ndarray]:
    """Returns the contact tables of a system.

    The rows are sorted by body. Contacts with the ground are before contacts with
    walls, and contacts of pairs are last.

    Args:
        robot: The robot.
        scene: The scene. ``None``: no obstacles.
        bodies: Bodies of the robot.
        obstacles: Number of rows of the obstacle tables. Row 0 is the ground.

    Raises:
        RobotDescriptionError: The robot or the scene names a link or collider that
            does not exist.
    """
    rows = list(_ground_contacts(robot, bodies))
    # after the contacts: a foot may lack its contact because of a typo in the contact
    check_feet(robot)
    if scene is not None:
        colliders = {
            name: (i, tuple(shape for shape in body.shapes if shape.link == name))
            for i, body in enumerate(bodies)
            for name in body.links
        }
        rows += wall_contacts(robot, scene, obstacles, colliders)
    start = len(rows)
    rows += [side for pair in _pair_sides(robot, bodies) for side in pair]
    order = sorted(range(len(rows)), key=lambda row: rows[row].body)
    place = np.argsort(np.array(order, dtype=np.int32), kind="stable")
    rows = [rows[row] for row in order]
    pairs = place[start:].reshape(-1, 2)
    return {
        "contact_body": np.array([row.body for row in rows], dtype=np.int32),
        "contact_obstacle": np.array([row.obstacle for row in rows], dtype=np.int32),
        "contact_position": np.array([row.position for row in rows]).reshape(-1, 3),
        "contact_segment": np.array([row.segment for row in rows]).reshape(-1, 3),
        "contact_radius": np.array([row.radius for row in rows], dtype=np.float64),
        "contact_pairs": pairs.astype(np.int32),
    }
