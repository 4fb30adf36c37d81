"""The state of a gradient arborescence."""

from __future__ import annotations

from typing import Any

import jax
from qdax.core.emitters.emitter import EmitterState

from newton_qd.qd.emitters.cma_es import CMAESState


class ArborescenceState(EmitterState):
    """State of E solution points.

    The state contains the coefficients of the next offspring, so that emitting and
    updating use the same ones.

    Attributes:
        key: Random key of the next update.
        points: (E, size) solution points theta.
        gradients: (E, 1 + D, size) normalized gradients of the points.
        finite: (E,) whether scores and gradients of the points are finite.
        bars: (cells,) fitness above which an offspring enters the archive.
        cma_es: Search distributions of the coefficients, leaves (E, ...).
        optimizer: State of what moves the points, leaves (E, ...).
        coefficients: (E, B - 1, 1 + D) coefficients of the offspring.
        age: (E,) updates since the last restart.
        restarts: () number of restarts of all points so far.
        rejected: () number of individuals so far with a score that is not finite, plus
            the number of points with a gradient that is not finite.
    """

    key: jax.Array
    points: jax.Array
    gradients: jax.Array
    finite: jax.Array
    bars: jax.Array
    cma_es: CMAESState
    optimizer: Any
    coefficients: jax.Array
    age: jax.Array
    restarts: jax.Array
    rejected: jax.Array
