"""Rules for the restart of a solution point from an elite."""

from __future__ import annotations

import enum


class RestartRule(enum.Enum):
    """Rule for restarts; a point with a converged CMA-ES always restarts.

    Attributes:
        NO_IMPROVEMENT: Restart if no offspring would enter the archive (Fontaine &
            Nikolaidis 2021).
        BASIC: No other restarts (Fontaine & Nikolaidis 2023).
    """

    NO_IMPROVEMENT = "no_improvement"
    BASIC = "basic"
