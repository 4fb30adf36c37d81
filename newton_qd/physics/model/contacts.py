"""Finds what of a robot touches what: the ground, the walls, its own links."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from newton_qd.checks import Fact, listed
from newton_qd.physics import reference
from newton_qd.physics.model.description import Body
from newton_qd.physics.model.elements import Shape
from newton_qd.physics.model.robot_checks import check_feet, index_of, refusal
from newton_qd.physics.model.scene import (
    TOUCHING,
    ContactRow,
    wall_contacts,
    whole_collider,
)
from newton_qd.physics.system import System
from newton_qd.robots import Contact, RobotSpec
from newton_qd.scenes import Scene


def body_of(robot: RobotSpec, field: str, link: str, bodies: list[Body]) -> int:
    """Returns the body that holds a link which the robot's field names.

    Raises:
        RobotDescriptionError: No body does.
    """
    links = {name: i for i, body in enumerate(bodies) for name in body.links}
    index_of(robot, field, link, tuple(links))
    return links[link]


def _contact_sphere(shape: Shape, end: int) -> tuple[np.ndarray, float]:
    """Returns centre (3,) in the body and radius of one end of a collider [m]."""
    axis = reference.rotation_matrix(shape.frame[3:])[:, 2]
    half_length = shape.size[1] if end else 0.0
    return shape.frame[:3] + end * half_length * axis, float(shape.size[0])


def _colliders(contact: Contact, body: Body, kinds: tuple[str, ...]) -> list[Shape]:
    """Returns the colliders of a link, of given kinds, that a row's contact names."""
    return [
        shape
        for shape in body.shapes
        if shape.link == contact.link
        and shape.kind in kinds
        and contact.collider in (None, shape.name)
    ]


def _collider(robot: RobotSpec, contact: Contact, body: Body) -> Shape:
    """Returns the one collider of a body that a row's contact means."""
    kind = "capsule" if contact.end else "sphere"
    found = _colliders(contact, body, (kind,))
    if len(found) != 1:
        named = "" if contact.collider is None else f" named {contact.collider!r}"
        raise refusal(
            robot,
            f"contacts: end of {contact.link!r}",
            contact.end,
            "exactly one, with end 0 for a sphere, 1 or -1 for a capsule, and its name "
            "in the file where there are several",
            why=f"which needs a {kind} collider{named}, and the link has {len(found)}",
        )
    return found[0]


def _ground_contacts(robot: RobotSpec, bodies: list[Body]) -> Iterator[ContactRow]:
    """Pairs the spheres of the robot's row with the ground."""
    # a collider may be named or be the only one of its kind: both ways mean the same
    seen: set[tuple[int, int]] = set()
    for contact in robot.contacts:
        body = body_of(robot, "contacts", contact.link, bodies)
        shape = _collider(robot, contact, bodies[body])
        if (id(shape), contact.end) in seen:
            given = Fact(f"{contact.end} twice")
            field = f"contacts: end of {contact.link!r}"
            raise refusal(robot, field, given, "each once")
        seen.add((id(shape), contact.end))
        centre, radius = _contact_sphere(shape, contact.end)
        yield ContactRow(body, 0, centre, np.zeros(3), radius)


def _pair_sides(
    robot: RobotSpec, bodies: list[Body]
) -> Iterator[tuple[ContactRow, ContactRow]]:
    """Returns both sides of the pairs of the robot's row, the shorter one first."""
    for pair in robot.pairs:
        sides = []
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
        first, second = sides
        if first.body == second.body:
            given = Fact(f"{pair[0].link!r} and {pair[1].link!r}")
            allowed = "links with a joint between them"
            raise refusal(robot, "pairs", given, allowed, why="which move as one body")
        # from a sphere the nearest point of a segment is exact, not the other way round
        swap = np.linalg.norm(first.segment) > np.linalg.norm(second.segment)
        yield (second, first) if swap else (first, second)


def contact_tables(
    robot: RobotSpec, scene: Scene | None, bodies: list[Body], obstacles: int
) -> dict[str, np.ndarray]:
    """Returns the contact tables of a system.

    They are sorted by body; the ground comes before the walls, these before pairs.

    Args:
        robot: The robot's row.
        scene: The scene's row, if there is one.
        bodies: Bodies of the robot.
        obstacles: Rows of the obstacle tables; row 0 is the ground.

    Raises:
        RobotDescriptionError: A row names links or colliders that are not there.
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
        "contact_pair_share": np.full(len(pairs), 0.5),
    }


def pair_shares(system: System) -> np.ndarray:
    """Returns how much of a pair's motion an impulse gives to its first side (np,).

    Both are moved at the centres of their colliders, in the default pose and in all
    directions alike. Shares near 0 and 1, of bodies that hardly move, are cut off:
    they would only add stiffness to such a body.
    """
    if not len(system.contact_pairs):
        return np.zeros(0)
    compliance = np.linalg.inv(reference.mass_matrix(system, system.rest_q))
    frames = reference.body_frames(system, system.rest_q)
    linear, angular = reference.jacobians(system, system.rest_q)

    def mobility(row: int) -> float:
        body = system.contact_body[row]
        arm = system.contact_position[row] - system.com[body]
        arm = reference.rotation_matrix(frames[body, 3:]) @ arm
        moved = linear[body] + np.cross(angular[body].T, arm).T
        return float(np.trace(moved @ compliance @ moved.T))

    sides = np.array([[mobility(row) for row in pair] for pair in system.contact_pairs])
    share = sides[:, 0] / np.maximum(sides.sum(axis=1), 1e-30)
    return np.clip(share, 0.01, 0.99)
