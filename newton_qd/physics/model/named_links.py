"""The bodies whose links a robot's spec names.

Links that are fixed to each other are one body, and each of them names it.
"""

from __future__ import annotations

import numpy as np

from newton_qd.checks import Fact, listed
from newton_qd.physics.model.description import Body
from newton_qd.physics.model.robot_checks import index_of, refusal
from newton_qd.physics.model.xml_reader import IDENTITY
from newton_qd.robots import RobotSpec

_SAME = 1e-9  # of two frames [m], [-]


def body_of(robot: RobotSpec, field: str, link: str, bodies: list[Body]) -> int:
    """Returns the index of the body that contains a link.

    Args:
        robot: The robot.
        field: Field of the robot that names the link, for the error message.
        link: Name of the link.
        bodies: Bodies of the robot.

    Raises:
        RobotDescriptionError: No body contains the link.
    """
    links = {name: i for i, body in enumerate(bodies) for name in body.links}
    index_of(robot, field, link, tuple(links), "a moving link ")
    return links[link]


def torso_body(robot: RobotSpec, bodies: list[Body]) -> int:
    """Returns the index of the body whose frame is the position of the robot.

    Args:
        robot: The robot.
        bodies: Bodies of the robot.

    Raises:
        RobotDescriptionError: No body contains the torso, or the torso is fixed to
            another link and stands apart from it.
    """
    found = body_of(robot, "torso", robot.torso, bodies)
    body = bodies[found]
    if np.abs(body.links[robot.torso] - IDENTITY).max() > _SAME:
        frames = body.links.items()
        same = [name for name, at in frames if np.abs(at - IDENTITY).max() <= _SAME]
        why = f"which is fixed to {body.link.name!r}, at another place or turned"
        raise refusal(robot, "torso", robot.torso, listed(same), why=why)
    return found


def feet_bodies(robot: RobotSpec, bodies: list[Body]) -> np.ndarray:
    """Returns the indices (nf,) of the bodies of the feet.

    Args:
        robot: The robot.
        bodies: Bodies of the robot.

    Raises:
        RobotDescriptionError: No body contains a foot, or one contains two, which
            would always read the same.
    """
    found: dict[int, str] = {}
    for foot in robot.feet:
        body = body_of(robot, "feet", foot, bodies)
        if body in found:
            given = Fact(f"{found[body]!r} and {foot!r}")
            why = "which are fixed to each other, so they touch as one"
            allowed = "links with a joint between them"
            raise refusal(robot, "feet", given, allowed, why=why)
        found[body] = foot
    return np.array(list(found), dtype=np.int32)
