"""How many substeps a control step of a robot needs."""

from __future__ import annotations

import math

import numpy as np

from newton_qd.checks import Fact, message
from newton_qd.physics import reference
from newton_qd.physics.system import JointKind, System, takes_system

FAST_TURN = 0.25
"""Turn of a joint in a substep from which velocity products change within it [rad]."""
UNEQUAL = 1e-3
"""Share of the moments of a free body by which they differ, from which it tumbles."""
LARGEST_TURN = 0.42
"""Largest turn of a joint in a substep that is recommended [rad].

The error of a substep is a share of turn^4 / 8 of the amplitude of a motion
(docs/physics.md, "Velocity products"), here 0.4 %. Measured: the halfcheetah turns by
0.41 rad and keeps its energy. With 0.57 rad, 4 % of its worlds do not.
"""
LARGEST_PHASE = math.sqrt(3.0)
"""Largest product of h and the frequency of a contact that is recommended [rad].

The last solve takes normal impulses as given. An explicit spring is unstable above 2
(Hairer, Lubich, Wanner 2003, "Geometric numerical integration illustrated by the
Stoermer-Verlet method"). Measured: at 2.1, up to 30 % of the worlds gain energy. Below
2, at most one of 128 does.
"""
LONGEST = 0.01
"""Longest substep that is recommended, the longest of the suite [s]."""
_TURN = 2.0 * math.pi  # range of a hinge without limits [rad]
_SLIDE = 1.0  # range of a slide without limits [m]


class FewSubstepsWarning(UserWarning):
    """The substeps of a robot are so long that its energy can grow."""


def inner_torques(system: System) -> np.ndarray:
    """Returns the torque (nv,) that turns each hinge inside the robot [N m].

    It is the gear, and for a hinge without motor the largest gear of the robot. It is
    zero for slides, and for hinges that no mass before them carries.
    """
    gear = np.full(system.nv, system.gear.max(initial=0.0) or 1.0)
    gear[system.control_dof] = system.gear
    torques = np.zeros(system.nv)
    carried = np.zeros(system.nb, dtype=bool)  # a body before it has mass
    for body, parent in enumerate(system.parent):
        if parent >= 0:
            carried[body] = carried[parent] or system.mass[parent] > 0
        if carried[body] and system.joint_kind[body] == JointKind.REVOLUTE:
            dof = system.v_start[body]
            torques[dof] = gear[dof]
    return torques


def fastest_turns(system: System) -> np.ndarray:
    """Returns how far each hinge turns in a substep at its final speed (nv,) [rad].

    The final speed of a hinge is that at which its damping takes up all its torque: its
    gear, and for a joint without motor the largest gear of the robot. Joints of the
    root do not count, because no inner torque turns them.
    """
    return system.h * inner_torques(system) / np.maximum(system.damping, 1e-12)


def tumbles(system: System) -> bool:
    """Returns whether a free body without joints is no ball with equal moments.

    Nothing damps its rotation, and its gyroscopic moment changes within a substep.
    """
    for body in np.flatnonzero(system.joint_kind == JointKind.FREE):
        if np.any(np.asarray(system.parent) == body):
            continue
        moments = np.linalg.eigvalsh(system.inertia[body])
        offset = system.mass[body] * float(np.sum(system.com[body] ** 2))
        if max(moments[-1] - moments[0], offset) > UNEQUAL * moments[-1]:
            return True
    return False


def iterates(system: System) -> bool:
    """Returns whether substeps update velocity products in several iterations.

    So do robots without contacts, those with a joint that can turn fast, and systems
    with a free body that tumbles.
    """
    free = not len(system.contact_body)
    fast = bool(fastest_turns(system).max(initial=0.0) > FAST_TURN)
    return free or fast or tumbles(system)


def joint_speeds(system: System) -> np.ndarray:
    """Returns the largest speed (nv,) to which motors bring each hinge [rad/s].

    Two bounds hold, and the lower one counts:

    - Damping: at gear / damping, it takes up the whole torque.
    - Energy: over its range, a motor does the work E = gear * range. A limit without
      dissipation gives the energy back, and the motor adds to it: E counts twice. With
      the energy E = v^T M v / 2, the speed of joint i is at most sqrt(2 E (M^-1)_ii),
      by the inequality of Cauchy and Schwarz. M belongs to the default pose.

    A hinge without motor gets the work of the strongest motor. Slides, hinges of the
    root without motor, and robots without motors have a speed of 0.
    """
    speeds = np.zeros(system.nv)
    if not system.nu:
        return speeds
    torques = inner_torques(system)
    turns = np.zeros(system.nv, dtype=bool)
    for body, kind in enumerate(system.joint_kind):
        turns[system.v_start[body]] = kind == JointKind.REVOLUTE
    spans = system.limit_upper - system.limit_lower
    spans = np.where(np.isfinite(spans), spans, np.where(turns, _TURN, _SLIDE))
    passes = 1.0 if system.robot.material.limit_dissipation > 0.0 else 2.0
    driven = system.control_dof
    torques[driven] = np.where(turns[driven], system.gear, 0.0)
    done = passes * system.gear * spans[driven]
    work = np.full(system.nv, done.max())
    work[driven] = done
    mobility = np.diag(np.linalg.inv(reference.mass_matrix(system, system.rest_q)))
    gained = np.sqrt(2.0 * work * mobility)
    return np.where(
        torques > 0.0,
        np.minimum(torques / np.maximum(system.damping, 1e-12), gained),
        speeds,
    )


def contact_masses(system: System) -> np.ndarray:
    """Returns the smallest mass (nc,) that moves with each contact point [kg].

    It is the inverse of the largest eigenvalue of J M^-1 J^T, where J (3, nv) is the
    Jacobian of the point in the default pose.
    """
    masses = np.full(len(system.contact_body), np.inf)
    if not len(masses):
        return masses
    mobility = np.linalg.inv(reference.mass_matrix(system, system.rest_q))
    frames = reference.body_frames(system, system.rest_q)
    linear, angular = reference.jacobians(system, system.rest_q)
    for c, body in enumerate(system.contact_body):
        arm = system.contact_position[c] - system.com[body]
        arm = reference.rotation_matrix(frames[body, 3:]) @ arm
        moved = linear[body] + np.cross(angular[body].T, arm).T
        largest = np.linalg.eigvalsh(moved @ mobility @ moved.T)[-1]
        masses[c] = 1.0 / max(float(largest), 1e-12)
    return masses


def needed_substeps(system: System) -> tuple[float, float]:
    """Returns the substeps that fast joints need, and those that contacts need.

    A force through the centre of mass of a free robot moves the whole robot and turns
    nothing. The solves find it exactly, so this part of the mobility does not count.
    """
    dt = system.robot.dt
    fastest = float(joint_speeds(system).max(initial=0.0))
    mobility = float((1.0 / contact_masses(system)).max(initial=0.0))
    if system.torso_floats:
        mobility = max(mobility - 1.0 / system.total_mass, 0.0)
    frequency = math.sqrt(system.contact_stiffness * mobility)
    return dt * fastest / LARGEST_TURN, dt * frequency / LARGEST_PHASE


@takes_system
def recommended_substeps(system: System) -> int:
    """Computes how many substeps a control step of a robot needs to keep its energy.

    In each of them, no joint turns by more than 0.42 rad, and the product of h and the
    frequency of every contact is at most 1.73. No substep is longer than 10 ms.
    ``RobotSpec(substeps=None)`` takes this number. It does not depend on the substeps
    that the robot has.

    The speed of a joint is bounded by its damping (gear / damping), and by the work of
    its motor over its range. The work of gravity does not count. The frequency of a
    contact is sqrt(stiffness / mass), with the smallest mass that moves with the
    contact point. Both are computed in the default pose. docs/physics.md, "Number of
    substeps", has the reasons.

    Args:
        system: The system.
    """
    needed = max(*needed_substeps(system), system.robot.dt / LONGEST)
    return max(1, math.ceil(needed * (1.0 - 1e-9)))  # not one more for rounding


def few_substeps(system: System) -> tuple[str, ...]:
    """Returns a text if the robot needs more substeps than it has.

    Args:
        system: The system.
    """
    joints, contacts = needed_substeps(system)
    if max(joints, contacts) * (1.0 - 1e-9) <= system.substeps:
        return ()
    if joints >= contacts:
        speeds = joint_speeds(system)
        dof = int(np.argmax(speeds))
        body = int(np.flatnonzero(system.v_start == dof)[0])
        turn = system.h * float(speeds[dof])
        cause = f"joint {system.joint_names[body]!r} can turn by {turn:.2g} rad in one"
        remedy = "more damping or a smaller gear"
    else:
        masses = contact_masses(system)
        c = int(np.argmin(masses))
        link = system.body_names[system.contact_body[c]]
        cause = f"a contact of {link!r} moves {masses[c]:.2g} kg, too little for"
        cause += f" {system.contact_stiffness:.3g} N/m"
        remedy = "a larger Material.static_penetration"
    allowed = (
        f"{recommended_substeps(system)} or more, or None, which takes this number; "
        f"with fewer, the energy can grow. With {remedy}, fewer are needed "
        "(newton_qd.physics.recommended_substeps)"
    )
    name = f"robot {system.robot.name!r}, substeps"
    return (message(name, Fact(str(system.substeps)), allowed, why=cause),)
