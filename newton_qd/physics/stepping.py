"""How a substep is solved: how often, and with which velocities."""

from __future__ import annotations

import dataclasses

from newton_qd.physics.model.substeps import FAST_TURN as FAST_TURN
from newton_qd.physics.model.substeps import fastest_turns as fastest_turns
from newton_qd.physics.model.substeps import iterates
from newton_qd.physics.system import System


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

    @property
    def friction_answers(self) -> float:
        """Share of friction in the given solves that answers the new velocity.

        The rest is given like the normal impulse, and stays in its cone. With less than
        an eighth, light feet gain energy (docs/physics.md, "Friction weight").
        """
        return 1.0 if self.iterations == 1 else 0.125


def substep_solves(system: System) -> Solves:
    """Returns how the substeps of a system are solved.

    All have three solves. A robot without contacts, or with a joint that can turn fast,
    updates its velocity products in each of them. Others are damped so much that the
    velocity products at the start serve.
    """
    if iterates(system):
        return Solves(iterations=3, solves=1)
    return Solves(iterations=1, solves=3)
