"""Scores of an archive that see the quality of its elites, not only their number.

A QD score with a reward offset is mostly the number of filled cells. These functions
leave the offset out. They are pure functions of the fitness of each cell, (cells,),
``-inf`` in empty cells, as NumPy or JAX arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from newton_qd.checks import message


def coverage(fitnesses: Any) -> Any:
    """Returns the share of filled cells [%].

    Args:
        fitnesses: (cells,) fitness of each cell, ``-inf`` in empty cells.
    """
    xp = fitnesses.__array_namespace__()
    return 100 * xp.mean(xp.astype(xp.isfinite(fitnesses), fitnesses.dtype))


def best(fitnesses: Any) -> Any:
    """Returns the highest fitness.

    Args:
        fitnesses: (cells,) fitness of each cell, ``-inf`` in empty cells.
    """
    return fitnesses.__array_namespace__().max(fitnesses)


def mean_fitness(fitnesses: Any) -> Any:
    """Returns the mean fitness of the elites, NaN without elites.

    Args:
        fitnesses: (cells,) fitness of each cell, ``-inf`` in empty cells.
    """
    xp = fitnesses.__array_namespace__()
    filled = xp.isfinite(fitnesses)
    number = xp.sum(xp.astype(filled, fitnesses.dtype))
    total = xp.sum(xp.where(filled, fitnesses, 0))
    # no division by zero: NumPy would warn
    return xp.where(number > 0, total / xp.where(number > 0, number, 1), xp.nan)


def offset_qd_score(fitnesses: Any, offset: float) -> Any:
    """Returns the QD score: the sum of fitness plus offset over filled cells.

    Args:
        fitnesses: (cells,) fitness of each cell, ``-inf`` in empty cells.
        offset: Number that makes fitnesses positive.
    """
    xp = fitnesses.__array_namespace__()
    return xp.sum(xp.where(xp.isfinite(fitnesses), fitnesses + offset, 0))


def qd_gain(fitnesses: Any, untrained: Any) -> Any:
    """Returns the QD score without offset: what elites have above an untrained policy.

    It is the sum over filled cells. An elite that is worse than an untrained policy
    counts 0.

    Args:
        fitnesses: (cells,) fitness of each cell, ``-inf`` in empty cells.
        untrained: () fitness of an untrained policy.
    """
    xp = fitnesses.__array_namespace__()
    gain = xp.where(xp.isfinite(fitnesses), fitnesses - untrained, 0)
    return xp.sum(xp.where(gain < 0, 0, gain))


def normalized_qd_score(
    fitnesses: np.ndarray, untrained: float, best_known: float
) -> float:
    """Returns the mean normalized fitness over all cells.

    A fitness is normalized to 0 for an untrained policy and 1 for the best known one.
    An empty cell counts 0, and so does an elite that is worse than an untrained policy.

    Args:
        fitnesses: (cells,) fitness of each cell, ``-inf`` in empty cells.
        untrained: Fitness of an untrained policy.
        best_known: Fitness of the best known policy.

    Raises:
        ValueError: The best known policy is not better than an untrained one.
    """
    if not best_known > untrained:
        allowed = f"above untrained = {untrained!r}"
        raise ValueError(message("best_known", best_known, allowed))
    gain = float(qd_gain(np.asarray(fitnesses, np.float64), untrained))
    return gain / (best_known - untrained) / len(fitnesses)


def common_cells(archives: Sequence[np.ndarray]) -> np.ndarray:
    """Returns whether all archives fill a cell, (cells,).

    Args:
        archives: Fitnesses (cells,) of archives with the same cells.
    """
    return np.all(np.isfinite(np.stack(archives)), axis=0)


def common_mean_fitness(archives: Sequence[np.ndarray]) -> np.ndarray:
    """Returns the mean fitness of each archive over the cells that all of them fill.

    Coverage has no effect on it: it compares elites of the same cells.

    Args:
        archives: Fitnesses (cells,) of A archives with the same cells.

    Returns:
        (A,) mean fitnesses, NaN if there is no such cell.
    """
    common = common_cells(archives)
    if not common.any():
        return np.full(len(archives), np.nan)
    return np.stack(archives)[:, common].mean(axis=1)


def ccdf(fitnesses: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """Returns the share of all cells whose fitness reaches a threshold [%].

    It is the complementary cumulative distribution function of the fitness over cells.
    At a very low threshold, it is the coverage.

    Args:
        fitnesses: (cells,) fitness of each cell, ``-inf`` in empty cells.
        thresholds: (K,) thresholds.
    """
    reached = np.asarray(fitnesses)[:, None] >= np.asarray(thresholds)
    return 100.0 * reached.mean(axis=0)
