"""Rules for the restart of a solution point, an actor or a climber from an elite."""

from __future__ import annotations

import enum

import jax
import numpy as np

LONGEST_LIFE = 2**30
"""Largest lifetime [generations]: JAX counts in 32 bits."""


class RestartRule(enum.Enum):
    """Rule for restarts; a point with a converged CMA-ES always restarts.

    Attributes:
        NO_IMPROVEMENT: Restart if no offspring would enter the archive (Fontaine &
            Nikolaidis 2021).
        BASIC: No other restarts (Fontaine & Nikolaidis 2023).
    """

    NO_IMPROVEMENT = "no_improvement"
    BASIC = "basic"


def due_for_restart(generation: jax.Array, lifetime: int, count: int) -> jax.Array:
    """Returns which of several actors are at the end of their lifetime (count,).

    They restart one after the other, so that there are actors of all ages.

    Args:
        generation: () number of generations so far.
        lifetime: Generations between two restarts of an actor, at most 2^30.
        count: Number of actors.
    """
    # with 64 bits, because the product may have more than 32
    turn = (np.arange(count, dtype=np.int64) * lifetime // count).astype(np.int32)
    return (generation % lifetime + turn) % lifetime == 0
