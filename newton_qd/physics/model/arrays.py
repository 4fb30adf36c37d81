"""Arrays of a System that come from a robot's file and its ``RobotSpec``."""

from __future__ import annotations

import numpy as np

from newton_qd.physics import reference
from newton_qd.physics.model.description import Body
from newton_qd.physics.model.verify import BuiltModel
from newton_qd.physics.model.xml_reader import IDENTITY
from newton_qd.physics.system import JointKind
from newton_qd.robots import RobotSpec

_DEFAULT_GEAR = 100.0  # [N m]


def body_arrays(bodies: list[Body]) -> dict[str, np.ndarray]:
    """Returns the joint frames and the inertias, arrays of shape (nb, ...)."""
    joints = [body.joint for body in bodies]
    return {
        "joint_axis": np.array([j.axis if j else np.zeros(3) for j in joints]),
        "parent_frame": np.array([j.frame if j else IDENTITY for j in joints]),
        "child_frame": np.tile(IDENTITY, (len(bodies), 1)),
        "mass": np.array([body.link.mass for body in bodies]),
        "com": np.array([body.link.com for body in bodies]),
        "inertia": np.array([body.link.inertia for body in bodies]),
    }


def dof_arrays(
    robot: RobotSpec, built: BuiltModel, bodies: list[Body], control: dict
) -> dict[str, np.ndarray]:
    """Returns the joint springs, dampers and limits, arrays of shape (nv,)."""
    nv = int(sum(6 if kind == JointKind.FREE else 1 for kind in built.joint_kind))
    lower, upper = np.full(nv, -np.inf), np.full(nv, np.inf)
    damping = np.zeros(nv)
    for start, body in zip(built.v_start, bodies, strict=True):
        if body.joint is not None:
            lower[start], upper[start] = body.joint.lower, body.joint.upper
            damping[start] = body.joint.damping
    gear = np.full(nv, control["gear"].max(initial=0.0) or _DEFAULT_GEAR)
    gear[control["control_dof"]] = control["gear"]
    # A servo is a spring towards the angle 0, plus a torque from its target angle. Both
    # are integrated implicitly.
    servo = [joint in robot.servos for joint, _ in robot.actuators]
    stiffness = np.zeros(nv)
    stiffness[control["control_dof"][servo]] = control["gear"][servo]
    limited = np.isfinite(lower) | np.isfinite(upper)
    width, overshoot = robot.material.limit_smoothing, robot.material.limit_overshoot
    compressed = reference.penetration(width - overshoot, width)
    return {
        "armature": np.zeros(nv),
        "damping": damping,
        "stiffness": stiffness,
        "spring_rest": np.zeros(nv),
        "limit_lower": lower,
        "limit_upper": upper,
        "limit_stiffness": np.where(limited, gear / compressed, 0.0),
    }
