"""Limits that hold too little: for the weight on a joint, or for a short slide."""

from __future__ import annotations

import numpy as np

from newton_qd.checks import Fact, message
from newton_qd.physics import reference
from newton_qd.physics.system import JointKind, System

# More gets a warning, as a share of what is held. The suite has at most 0.25.
_EXPECTED = 2.0
_ROUNDING = 1e-9  # 0.15 - 0.05 is less than 0.1


class SoftLimitWarning(UserWarning):
    """Limits hold less than half of the weight on a joint, or a slide is short."""


def held_at_limits(system: System) -> np.ndarray:
    """Returns the torque or force (nv,) at ``limit_overshoot`` [N m or N].

    It is the gear of the motor, and for a joint without motor the largest gear of the
    robot.
    """
    material = system.robot.material
    width, overshoot = material.limit_smoothing, material.limit_overshoot
    return system.limit_stiffness * reference.penetration(width - overshoot, width)


def limit_loads(system: System) -> np.ndarray:
    """Returns how much weight presses each joint beyond a limit (nv,) [N m or N].

    The joint is at the limit where this is more, and the others are in the default
    pose. It counts what hangs on the joint, seen from the root.
    """
    frames = reference.body_frames(system, system.rest_q)
    mass = np.array(system.mass, np.float64)
    moment = np.array(
        [
            weight * (frame[:3] + reference.rotation_matrix(frame[3:]) @ com)
            for weight, frame, com in zip(mass, frames, system.com, strict=True)
        ]
    )
    loads = np.zeros(system.nv)
    for body in reversed(range(system.nb)):
        if system.joint_kind[body] != JointKind.FREE and mass[body] > 0:
            loads[system.v_start[body]] = _load(
                system, body, frames[body], mass[body], moment[body] / mass[body]
            )
        parent = system.parent[body]
        if parent >= 0:
            mass[parent] += mass[body]
            moment[parent] += moment[body]
    return loads


def _load(
    system: System, body: int, frame: np.ndarray, mass: float, centre: np.ndarray
) -> float:
    """Returns the load of one joint.

    Args:
        system: The system.
        body: Body behind the joint.
        frame: (7,) its frame in the default pose.
        mass: Mass of all that hangs on the joint [kg].
        centre: (3,) its centre of mass in the default pose [m].
    """
    dof = system.v_start[body]
    side = reference.compose(frame, system.child_frame[body])
    axis = reference.rotation_matrix(side[3:]) @ system.joint_axis[body]
    weight = np.array([0.0, 0.0, -mass * system.robot.gravity])
    hinge = system.joint_kind[body] == JointKind.REVOLUTE
    loads = [0.0]
    for limit, outwards in ((system.limit_lower, -1.0), (system.limit_upper, 1.0)):
        if not np.isfinite(limit[dof]):
            continue
        if hinge:
            angle = limit[dof] - system.rest_q[system.q_start[body]]
            turn = reference.rotation_matrix(
                reference.axis_quaternion(axis, float(angle))
            )
            force = float(axis @ np.cross(turn @ (centre - side[:3]), weight))
        else:
            force = float(axis @ weight)
        loads.append(outwards * force)
    return max(loads)


def soft_limits(system: System) -> tuple[str, ...]:
    """Returns a text about each joint whose limits hold too little.

    Such a joint carries more than twice what they hold. Or it is a slide, and the force
    that they hold pushes it further past a limit than the limits are apart.
    """
    loads, held = limit_loads(system), held_at_limits(system)
    overshoot = system.robot.material.limit_overshoot
    texts = []
    for body in np.flatnonzero(system.joint_kind != JointKind.FREE):
        dof = system.v_start[body]
        hinge = system.joint_kind[body] == JointKind.REVOLUTE
        unit, length = ("N m", "rad") if hinge else ("N", "m")
        name = f"robot {system.robot.name!r}, limits of {system.joint_names[body]!r}"
        span = system.limit_upper[dof] - system.limit_lower[dof]
        if not hinge and span < (1 - _ROUNDING) * overshoot:
            given = Fact(f"a range of {span:.3g} m")
            allowed = (
                f"at least {overshoot:g} m, as far as the gear of its motor pushes it "
                "past a limit or, without one, the robot's largest. A smaller "
                "Material.limit_overshoot makes limits stiffer"
            )
            texts.append(message(name, given, allowed))
        if loads[dof] <= _EXPECTED * held[dof]:
            continue
        past = overshoot * loads[dof] / held[dof]
        weight = Fact(f"a weight of {loads[dof]:.3g} {unit}")
        most = _EXPECTED * held[dof]
        allowed = (
            f"up to {most:.3g} {unit}, twice the gear of its motor or, without one, of "
            f"the robot's largest; it goes about {past:.2g} {length} past its "
            "limit. A smaller Material.limit_overshoot makes limits stiffer"
        )
        texts.append(message(name, weight, allowed))
    return tuple(texts)
