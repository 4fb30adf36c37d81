"""The default pose of a robot: the joint angles of its ``RobotSpec``, on the ground."""

from __future__ import annotations

import dataclasses

import numpy as np

from newton_qd.checks import Fact
from newton_qd.physics import reference
from newton_qd.physics.model.robot_checks import index_of, refusal
from newton_qd.physics.system import JointKind, System, takes_system


@takes_system
def raising_coordinate(system: System) -> tuple[int, float] | None:
    """Finds the coordinate that moves the torso up without rotating it.

    It is that of a free root, or else of the first vertical slide before the torso. A
    slide that a hinge tilts counts only if there is no other one.

    Args:
        system: The robot, in the pose ``rest_q``.

    Returns:
        Index of the coordinate, and the sign that means up. ``None`` if the robot has
        no such coordinate.
    """
    found = _raising(system)
    return None if found is None else found[:2]


def _raising(system: System) -> tuple[int, float, bool] | None:
    """Finds the coordinate that moves the torso up in the pose ``rest_q``.

    Returns:
        Index of the coordinate, the sign that means up, and whether a hinge before it
        tilts it in other poses. ``None`` if the robot has no such coordinate.
    """
    frames = reference.body_frames(system, system.rest_q)
    body = system.torso
    found: tuple[int, float, bool] | None = None
    while body >= 0:
        start, kind = int(system.q_start[body]), system.joint_kind[body]
        if kind == JointKind.FREE:
            return start + 2, 1.0, False
        side = reference.compose(frames[body], system.child_frame[body])
        axis = reference.rotation_matrix(side[3:]) @ system.joint_axis[body]
        vertical = abs(axis[2]) > 1 - 1e-9
        if kind == JointKind.PRISMATIC and vertical and (found is None or found[2]):
            found = start, float(np.sign(axis[2])), False
        elif kind == JointKind.REVOLUTE and not vertical and found is not None:
            found = found[0], found[1], True
        body = int(system.parent[body])
    return found


@takes_system
def grounding_coordinate(system: System) -> tuple[int, float] | None:
    """Finds the coordinate that places the robot on the ground in any pose.

    Args:
        system: The robot.

    Returns:
        Index of the coordinate that moves the torso up, and the sign that means up.
        ``None`` if the robot has no such coordinate or a hinge tilts it, if its
        ``RobotSpec`` sets the height, or if the robot has no ground contacts.
    """
    if system.robot.rest_height is not None or not len(own_ground_contacts(system)):
        return None
    found = _raising(system)
    return None if found is None or found[2] else found[:2]


def own_ground_contacts(system: System) -> np.ndarray:
    """Returns the ground contacts of the bodies that hang together with the torso.

    Other free bodies, such as a ball, do not move with the torso.

    Args:
        system: The robot.

    Returns:
        Their rows in the system's contact tables.
    """
    ground, roots = system.ground_contacts, system.roots
    return ground[roots[system.contact_body[ground]] == roots[system.torso]]


def rest_coordinates(system: System) -> np.ndarray:
    """Returns the coordinates (nq,) of the robot's default pose.

    Raises:
        RobotDescriptionError: The pose is outside the limits of the joints, or names a
            joint that does not exist.
    """
    robot = system.robot
    q = np.array(system.rest_q)
    free = system.q_start[system.joint_kind == JointKind.FREE]
    if system.free_root is None and any(robot.rest_rotation):
        why = "and the torso has no free root"
        raise refusal(robot, "rest_rotation", robot.rest_rotation, "zeros", why=why)
    for start in free:
        q[start + 6] = 1.0
    if system.free_root is not None:
        start = system.q_start[system.free_root]
        q[start + 3 : start + 7] = reference.rpy_quaternion(*robot.rest_rotation)
    for joint, angle in robot.rest_pose:
        q[system.q_start[index_of(robot, "rest_pose", joint, system.joint_names)]] = (
            angle
        )
    for body in np.flatnonzero(system.joint_kind != JointKind.FREE):
        dof, angle = system.v_start[body], q[system.q_start[body]]
        lower, upper = system.limit_lower[dof], system.limit_upper[dof]
        if not lower - 1e-9 <= angle <= upper + 1e-9:
            field = f"rest_pose: angle of {system.joint_names[body]!r}"
            allowed = f"{lower:g} to {upper:g}"
            raise refusal(robot, field, Fact(f"{angle:g}"), allowed)
    posed = dataclasses.replace(system, rest_q=q.copy())
    height = raising_coordinate(posed)
    if height is None:
        if robot.rest_height is not None:
            why = "and no coordinate raises the torso"
            raise refusal(robot, "rest_height", robot.rest_height, "None", why=why)
        return q
    coordinate, sign = height
    if robot.rest_height is not None:
        torso = reference.body_frames(posed, q)[system.torso, 2]
        q[coordinate] += sign * (robot.rest_height - torso)
    elif len(contacts := own_ground_contacts(posed)):
        q[coordinate] -= sign * reference.lowest_contact(posed, q, contacts)
    _check_raised(posed, q, coordinate, sign)
    return q


def _check_raised(system: System, q: np.ndarray, coordinate: int, sign: float) -> None:
    """Checks that the slide which raises the torso is within its limits.

    Raises:
        RobotDescriptionError: It is not.
    """
    body = int(np.searchsorted(system.q_start, coordinate, side="right")) - 1
    if system.joint_kind[body] == JointKind.FREE:
        return
    dof, value = system.v_start[body], float(q[coordinate])
    lower, upper = system.limit_lower[dof], system.limit_upper[dof]
    if not lower - 1e-9 <= value <= upper + 1e-9:
        given = system.robot.rest_height
        name = f"joint {system.joint_names[body]!r}"
        why = f"so that {name} must be at {value:g} m, outside {lower:g} to {upper:g} m"
        torso = reference.body_frames(system, q)[system.torso, 2]
        low, high = sorted(torso + sign * (np.array([lower, upper]) - value))
        allowed = f"a height of the torso of {low:g} to {high:g} m"
        raise refusal(system.robot, "rest_height", given, allowed, why=why)
