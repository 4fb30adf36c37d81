"""The bodies whose links a robot's spec names.

Links that are fixed to each other are one body, and each of them names it.
"""

from __future__ import annotations

import numpy as np

from newton_qd.checks import Fact, listed
from newton_qd.physics.model.description import Body
from newton_qd.physics.model.robot_checks import index_of, refusal
from newton_qd.robots import RobotSpec

_NEAR = 1e-6  # two positions that count as the same [m]
_TURNED = 1e-5  # two rotations, half of the angle [rad]; files round pi to six digits


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
    same = [name for name, at in body.links.items() if _is_identity(at)]
    if robot.torso not in same:
        why = f"which is fixed to {body.link.name!r}, at another place or turned"
        raise refusal(robot, "torso", robot.torso, listed(same), why=why)
    return found


def _is_identity(frame: np.ndarray) -> bool:
    """Returns whether a frame (7,) is the one in which it is given."""
    position, turn = frame[:3], frame[3:6]  # q and -q are the same rotation
    return bool(np.abs(position).max() <= _NEAR and np.abs(turn).max() <= _TURNED)


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
