"""Scores of an archive that see the quality of its elites, not only their number.

A QD score with a reward offset is mostly the number of filled cells. These functions
leave the offset out. They are pure functions of the fitness of each cell, (cells,),
``-inf`` in empty cells, as NumPy or JAX arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, message

_CELLS = "an array (cells,), with one fitness for each cell, and at least one cell"


def coverage(fitnesses: Any) -> Any:
    """Returns the share of filled cells [%].

    Args:
        fitnesses: (cells,) fitness of each cell, ``-inf`` in empty cells.

    Raises:
        TypeError: ``fitnesses`` is not an array.
        ValueError: It has another shape.
    """
    _check_cells(fitnesses)
    xp = fitnesses.__array_namespace__()
    return 100 * xp.mean(xp.astype(xp.isfinite(fitnesses), fitnesses.dtype))


def best(fitnesses: Any) -> Any:
    """Returns the highest fitness.

    Args:
        fitnesses: (cells,) fitness of each cell, ``-inf`` in empty cells.

    Raises:
        TypeError: ``fitnesses`` is not an array.
        ValueError: It has another shape.
    """
    _check_cells(fitnesses)
    return fitnesses.__array_namespace__().max(fitnesses)


def mean_fitness(fitnesses: Any) -> Any:
    """Returns the mean fitness of the elites, NaN without elites.

    Args:
        fitnesses: (cells,) fitness of each cell, ``-inf`` in empty cells.

    Raises:
        TypeError: ``fitnesses`` is not an array.
        ValueError: It has another shape.
    """
    _check_cells(fitnesses)
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

    Raises:
        TypeError: ``fitnesses`` is not an array.
        ValueError: It has another shape.
    """
    _check_cells(fitnesses)
    xp = fitnesses.__array_namespace__()
    return xp.sum(xp.where(xp.isfinite(fitnesses), fitnesses + offset, 0))


def qd_gain(fitnesses: Any, untrained: Any) -> Any:
    """Returns the QD score without offset: what elites have above an untrained policy.

    It is the sum over filled cells. An elite that is worse than an untrained policy
    counts 0.

    Args:
        fitnesses: (cells,) fitness of each cell, ``-inf`` in empty cells.
        untrained: () fitness of an untrained policy.

    Raises:
        TypeError: ``fitnesses`` is not an array.
        ValueError: It or ``untrained`` has another shape.
    """
    _check_cells(fitnesses)
    if np.shape(untrained) != ():
        raise ValueError(message("untrained", untrained, "one number"))
    xp = fitnesses.__array_namespace__()
    gain = xp.where(xp.isfinite(fitnesses), fitnesses - untrained, 0)
    return xp.sum(xp.where(gain < 0, 0, gain))


def normalized_qd_score(
    fitnesses: np.ndarray, untrained: Any, best_known: Any
) -> float:
    """Returns the mean normalized fitness over all cells.

    A fitness is normalized to 0 for an untrained policy and 1 for the best known one.
    An empty cell counts 0, and so does an elite that is worse than an untrained policy.

    Args:
        fitnesses: (cells,) fitness of each cell, ``-inf`` in empty cells.
        untrained: () fitness of an untrained policy.
        best_known: () fitness of the best known policy.

    Raises:
        TypeError: A fitness of a policy is not a number.
        ValueError: ``fitnesses`` has another shape, a fitness of a policy is not
            finite, or the best known policy is not better than an untrained one.
    """
    values = np.asarray(fitnesses, np.float64)
    _check_cells(values)
    untrained = _number("untrained", untrained)
    best_known = _number("best_known", best_known)
    if not best_known > untrained:
        allowed = f"above untrained = {untrained!r}"
        raise ValueError(message("best_known", best_known, allowed))
    gain = float(qd_gain(values, untrained))
    return gain / (best_known - untrained) / len(values)


def common_cells(archives: Sequence[np.ndarray]) -> np.ndarray:
    """Returns whether all archives fill a cell, (cells,).

    Args:
        archives: Fitnesses (cells,) of archives with the same cells.

    Raises:
        ValueError: There is no archive, or they differ in their number of cells.
    """
    return np.all(np.isfinite(_stacked(archives)), axis=0)


def common_mean_fitness(archives: Sequence[np.ndarray]) -> np.ndarray:
    """Returns the mean fitness of each archive over the cells that all of them fill.

    Coverage has no effect on it: it compares elites of the same cells.

    Args:
        archives: Fitnesses (cells,) of A archives with the same cells.

    Returns:
        (A,) mean fitnesses, NaN if there is no such cell.

    Raises:
        ValueError: There is no archive, or they differ in their number of cells.
    """
    common = common_cells(archives)
    if not common.any():
        return np.full(len(archives), np.nan)
    return _stacked(archives)[:, common].mean(axis=1)


def ccdf(fitnesses: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """Returns the share of all cells whose fitness reaches a threshold [%].

    It is the complementary cumulative distribution function of the fitness over cells.
    At a very low threshold, it is the coverage.

    Args:
        fitnesses: (cells,) fitness of each cell, ``-inf`` in empty cells.
        thresholds: (K,) thresholds.

    Raises:
        ValueError: An argument has another shape.
    """
    values, levels = np.asarray(fitnesses), np.asarray(thresholds)
    _check_cells(values)
    if levels.ndim != 1:
        raise ValueError(message("thresholds", levels, "an array (K,)"))
    return 100.0 * (values[:, None] >= levels).mean(axis=0)


def _number(name: str, value: Any) -> float:
    """Returns a number, which may be an array of shape (), such as a mean of JAX.

    Raises:
        TypeError: It is not a number.
        ValueError: It is not finite.
    """
    if getattr(value, "shape", None) == ():
        value = value.item()
    checks.number(name, value)
    return float(value)


def _check_cells(fitnesses: Any) -> None:
    """Checks that there is one fitness for each cell.

    Raises:
        TypeError: It is not an array.
        ValueError: It has another shape.
    """
    if not checks.is_array(fitnesses):
        raise TypeError(message("fitnesses", fitnesses, _CELLS))
    if len(fitnesses.shape) != 1 or not fitnesses.shape[0]:
        hint = "; of an archive of QDax, fitnesses[:, 0]"
        raise ValueError(message("fitnesses", fitnesses, _CELLS + hint))


def _stacked(archives: Sequence[np.ndarray]) -> np.ndarray:
    """Returns the fitnesses of archives (A, cells).

    Raises:
        ValueError: There is none, or they differ in their number of cells.
    """
    shapes = [np.shape(archive) for archive in archives]
    if len(set(shapes)) != 1 or len(shapes[0]) != 1:
        given = Fact(f"shapes {shapes}" if shapes else "none")
        allowed = "arrays (cells,) with the same number of cells, at least one"
        raise ValueError(message("archives", given, allowed))
    return np.stack(archives)
