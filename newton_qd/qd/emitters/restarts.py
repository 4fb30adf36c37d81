"""When a solution point gives up and starts again from an elite."""

from __future__ import annotations

import enum


class RestartRule(enum.Enum):
    """When an emitter restarts besides when its CMA-ES has converged.

    Attributes:
        NO_IMPROVEMENT: None of its offspring would enter the archive (Fontaine &
            Nikolaidis 2021).
        BASIC: Never (Fontaine & Nikolaidis 2023).
    """

    NO_IMPROVEMENT = "no_improvement"
    BASIC = "basic"
