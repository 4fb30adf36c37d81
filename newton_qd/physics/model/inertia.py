"""Checks at load that every joint moves enough inertia to be accelerated.

The kernels solve for accelerations with the articulated-body algorithm, in the
precision of the system. This module does the same elimination in double precision. It
compares what remains for a joint with the numbers that cancel on the way.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from newton_qd.checks import Fact, message
from newton_qd.physics import reference
from newton_qd.physics.model.xml_reader import RobotDescriptionError
from newton_qd.physics.system import JointKind, System

# A pivot may lose all but six bits to cancellation. Then a step is right to about 2 %.
_KEPT = 64
# Poses other than the default one. Almost every pose shows a robot that is singular in
# all poses. The best of several poses is not near a singular one by chance.
_POSES = 4


@dataclasses.dataclass(frozen=True)
class Pivot:
    """What is left for a joint to accelerate, and its size before cancellation.

    Attributes:
        body: Index of the body that the joint moves.
        left: Inertia of the joint after the joints below it moved freely.
        size: Sum of the absolute values from which ``left`` was computed.
    """

    body: int
    left: float
    size: float

    @property
    def share(self) -> float:
        """What is left, as a share of the numbers that cancel [-]."""
        return self.left / self.size if self.size > 0 else 0.0


def check_inertia(system: System, path: Path) -> None:
    """Checks that no joint moves a singular inertia.

    Checked are the default pose and some poses within the limits of the joints.

    Args:
        system: The robot, with its default pose.
        path: Its file, for the error.

    Raises:
        RobotDescriptionError: The inertia that a joint or the free root moves is zero,
            or so small that it is lost to rounding.
    """
    least = _KEPT * float(np.finfo(system.dtype).eps)
    at_rest = pivots(system, system.rest_q)
    rng = np.random.default_rng(0)
    poses = [pivots(system, _pose(system, rng)) for _ in range(_POSES)]
    best = [
        max(several, key=lambda pivot: pivot.share)
        for several in zip(*poses, strict=True)
    ]
    for found, where in ((best, ""), (at_rest, " in the default pose")):
        weak = [pivot for pivot in found if not pivot.share >= least]
        if weak:
            name, given, allowed = _refusal(system, weak[0], where, least)
            why = "which is singular or lost to rounding"
            raise RobotDescriptionError(
                message(f"{path}: inertia of {name}", given, allowed, why=why)
            )


def _refusal(
    system: System, pivot: Pivot, where: str, least: float
) -> tuple[str, Fact, str]:
    """Returns what has too little inertia, how little, and what is allowed."""
    link, joint = system.body_names[pivot.body], system.joint_names[pivot.body]
    if system.joint_kind[pivot.body] == JointKind.FREE:
        name = f"the floating root link {link!r} and all that hangs on it"
        cure = (
            f"an <inertial> on {link!r}, or fixed_base=True of the RobotSpec if the "
            "robot stands on the world"
        )
    else:
        name = f"link {link!r} and all that hangs on it, which joint {joint!r} moves"
        cure = f"an <inertial> on {link!r}, or fewer joints without mass between them"
    given = Fact(f"{max(pivot.share, 0.0):.2g} of its parts{where}")
    if system.dtype == "float32" and pivot.share >= _KEPT * np.finfo(float).eps:
        cure += ", or dtype='float64'"
    return name, given, f"at least {least:.2g}, so: {cure}"


def _pose(system: System, rng: np.random.Generator) -> np.ndarray:
    """Returns coordinates (nq,) within the limits of the joints."""
    q = system.rest_q.copy()
    for body in np.flatnonzero(system.joint_kind != JointKind.FREE):
        at, dof = system.q_start[body], system.v_start[body]
        reach = np.pi if system.joint_kind[body] == JointKind.REVOLUTE else 0.1
        lower = max(float(system.limit_lower[dof]), q[at] - reach)
        upper = min(float(system.limit_upper[dof]), q[at] + reach)
        q[at] = rng.uniform(lower, max(lower, upper))
    return q


def pivots(system: System, q: np.ndarray) -> list[Pivot]:
    """Returns the pivot of each joint at coordinates ``q`` (nq,), by body."""
    frames = reference.body_frames(system, q)
    first = np.zeros(3)
    first[: min(3, system.nq)] = q[:3]
    origin = first @ reference.origin_axes(system)
    left = np.zeros((system.nb, 6, 6))
    size = np.zeros((system.nb, 6, 6))
    found = []
    for body in reversed(range(system.nb)):
        own = _rigid_inertia(system, body, frames[body], origin)
        left[body] += own
        size[body] += np.abs(own)
        if system.joint_kind[body] == JointKind.FREE:
            scale = np.sqrt(np.diag(size[body]))
            with np.errstate(divide="ignore", invalid="ignore"):
                scaled = left[body] / np.outer(scale, scale)
            regular = bool(np.isfinite(scaled).all())
            share = float(np.linalg.eigvalsh(scaled)[0]) if regular else 0.0
            found.append(Pivot(body, share, 1.0))
            continue
        motion = _motion(system, body, frames[body], origin)
        force = left[body] @ motion
        dof = system.v_start[body]
        pivot = Pivot(
            body,
            float(motion @ force + system.armature[dof]),
            float(np.abs(motion) @ size[body] @ np.abs(motion) + system.armature[dof]),
        )
        found.append(pivot)
        parent = system.parent[body]
        if parent < 0:
            continue
        passed = np.zeros((6, 6))
        if pivot.left > 0:
            passed = np.outer(force, force) / pivot.left
        left[parent] += left[body] - passed
        size[parent] += size[body] + np.abs(passed)
    return found[::-1]


def _rigid_inertia(
    system: System, body: int, frame: np.ndarray, origin: np.ndarray
) -> np.ndarray:
    """Returns the inertia (6, 6) of a body about the origin, (angular, linear)."""
    rotation = reference.rotation_matrix(frame[3:])
    com = frame[:3] + rotation @ system.com[body] - origin
    lever = np.cross(com, np.eye(3)).T  # column i is com x e_i
    mass = system.mass[body]
    inertia = np.empty((6, 6))
    turned = rotation @ system.inertia[body] @ rotation.T
    inertia[:3, :3] = turned + mass * lever @ lever.T
    inertia[:3, 3:] = mass * lever
    inertia[3:, :3] = mass * lever.T
    inertia[3:, 3:] = mass * np.eye(3)
    return inertia


def _motion(
    system: System, body: int, frame: np.ndarray, origin: np.ndarray
) -> np.ndarray:
    """Returns the motion (6,) of a joint of unit velocity, (angular, linear)."""
    side = reference.compose(frame, system.child_frame[body])
    axis = reference.rotation_matrix(side[3:]) @ system.joint_axis[body]
    if system.joint_kind[body] == JointKind.PRISMATIC:
        return np.concatenate([np.zeros(3), axis])
    return np.concatenate([axis, np.cross(side[:3] - origin, axis)])
