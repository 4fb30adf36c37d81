"""How a substep is solved: how often, and with which velocities."""

from __future__ import annotations

import dataclasses

import numpy as np

from newton_qd.physics.system import JointKind, System

FAST_TURN = 0.25
"""Turn of a joint in a substep from which velocity products change within it [rad]."""


@dataclasses.dataclass(frozen=True)
class Solves:
    """Linear solves of a substep.

    Several iterations linearise contacts and limits about the velocity that the solve
    before found, and take the velocity products at the mean of the old and that
    velocity. One iteration takes both at the old velocity.

    Attributes:
        iterations: Iterations of a substep.
        solves: Solves of an iteration.
    """

    iterations: int
    solves: int

    @property
    def given(self) -> int:
        """First solve whose normal impulses are given: those before it, clipped.

        One iteration gives them to both correctors, as damped robots need no more.
        Several leave only the last solve, and Newton's method has two.
        """
        return 1 if self.iterations == 1 else self.iterations * self.solves - 1


def fastest_turns(system: System) -> np.ndarray:
    """Returns how far each hinge turns in a substep at its final speed (nv,) [rad].

    The final speed of a hinge is that at which its damping takes up all its torque: its
    gear, and for a joint without motor the largest gear of the robot. Joints of the
    root do not count, because no inner torque turns them.
    """
    h = system.robot.dt / system.robot.substeps
    gear = np.full(system.nv, system.gear.max(initial=0.0) or 1.0)
    gear[system.control_dof] = system.gear
    turns = np.zeros(system.nv)
    carried = np.zeros(system.nb, dtype=bool)  # a body before it has mass
    for body, parent in enumerate(system.parent):
        if parent >= 0:
            carried[body] = carried[parent] or system.mass[parent] > 0
        if carried[body] and system.joint_kind[body] == JointKind.REVOLUTE:
            dof = system.v_start[body]
            turns[dof] = h * gear[dof] / max(system.damping[dof], 1e-12)
    return turns


def substep_solves(system: System) -> Solves:
    """Returns how the substeps of a system are solved.

    All have three solves. A robot without contacts, or with a joint that can turn fast,
    updates its velocity products in each of them. Others are damped so much that the
    velocity products at the start serve.
    """
    free = not len(system.contact_body)
    if free or fastest_turns(system).max(initial=0.0) > FAST_TURN:
        return Solves(iterations=3, solves=1)
    return Solves(iterations=1, solves=3)
