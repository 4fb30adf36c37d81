"""Metrics of an archive without luck, from re-evaluated elites."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.envs.inputs import require_key
from newton_qd.qd.run import quality
from newton_qd.types import ScoringFunction


class Elites(Protocol):
    """An archive of this package, or a repertoire of QDax."""

    @property
    def genotypes(self) -> Any:
        """Pytree, leaves (cells, ...)."""
        ...

    @property
    def fitnesses(self) -> Any:
        """(cells,) or (cells, 1), ``-inf`` in empty cells."""
        ...

    @property
    def centroids(self) -> Any:
        """(cells, D) centres of the cells."""
        ...


@dataclasses.dataclass(frozen=True)
class Reevaluated:
    """Metrics of an archive that is rebuilt from re-evaluated elites.

    An elite enters it with the medians of its descriptors and of its fitnesses over
    evaluations from different start states (Flageat and Cully 2020,
    "Fast and stable MAP-Elites in noisy domains using deep grids"). The descriptor of
    an evaluation that is not finite does not count.

    Attributes:
        reevaluations: Evaluations of each elite.
        qd_score: QD score of this archive, with the task's reward offset.
        coverage: Its coverage [%].
        max_fitness: Its highest fitness.
        mean_fitness: Its mean fitness; ``None`` in files of an earlier version.
        qd_gain: Its QD score without offset; ``None`` if the fitness of an untrained
            policy was not given.
    """

    reevaluations: int
    qd_score: float
    coverage: float
    max_fitness: float
    mean_fitness: float | None = None
    qd_gain: float | None = None


def reevaluate(
    archive: Elites,
    score: ScoringFunction,
    key: jax.Array,
    *,
    reevaluations: int = 32,
    offset: float,
    untrained: float | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Reevaluated | None:
    """Evaluates the elites of an archive again: the corrected QD score.

    Args:
        archive: :class:`Archive`, or a repertoire of QDax, such as :func:`from_ribs`
            makes from an archive of pyribs. It has at least one elite.
        score: Scoring function, best under ``jax.jit``; all elites share a start state
            in each call.
        key: Key that is split into one key for each call.
        reevaluations: Number of calls, from 1.
        offset: Added to each elite's fitness in the QD score, such as
            ``task.qd_offset(episode_length)``.
        untrained: Fitness of an untrained policy, for the QD score without offset.
        stop: Called before each call of ``score``; true ends the re-evaluation.

    Returns:
        The metrics; ``None`` if ``stop`` returned true.

    Raises:
        TypeError: ``archive`` is no archive, ``score`` no function, or ``key`` no key.
        ValueError: The archive has no elite, or several fitnesses for each; ``key`` is
            several keys; ``reevaluations`` is no integer from 1; or ``offset`` is no
            finite number.
    """
    checks.function("score", score, "a scoring function")
    require_key("key", key)
    checks.integer("reevaluations", reevaluations)
    checks.number("offset", offset)
    best = corrected_fitnesses(archive, score, key, reevaluations, stop)
    if best is None:
        return None
    return Reevaluated(
        reevaluations=reevaluations,
        qd_score=float(quality.offset_qd_score(best, offset)),
        coverage=float(quality.coverage(best)),
        max_fitness=float(quality.best(best)),
        mean_fitness=float(quality.mean_fitness(best)),
        qd_gain=None if untrained is None else float(quality.qd_gain(best, untrained)),
    )


def corrected_fitnesses(
    archive: Elites,
    score: ScoringFunction,
    key: jax.Array,
    reevaluations: int,
    stop: Callable[[], bool] = lambda: False,
) -> np.ndarray | None:
    """Returns the fitness (cells,) of each cell after the elites were evaluated again.

    A fitness that is not finite counts as ``-inf`` in the median of the fitnesses. The
    descriptor of such an evaluation has no meaning. An elite with no other evaluation
    is left out.

    Args:
        archive: Archive with at least one elite.
        score: Compiled scoring function; all elites share a start state in each call.
        key: Key that is split into one key for each call.
        reevaluations: Number of calls.
        stop: Called before each call of ``score``.

    Returns:
        ``-inf`` in empty cells; ``None`` if ``stop`` returned true.

    Raises:
        TypeError: ``archive`` is no archive.
        ValueError: It has no elite, or several fitnesses for each.
    """
    filled = _filled(archive)
    genotypes = jax.tree.map(lambda leaf: jnp.asarray(leaf[filled]), archive.genotypes)
    fitnesses, descriptors = [], []
    for call_key in jax.random.split(key, reevaluations):
        if stop():
            return None
        fitness, descriptor, _ = score(genotypes, call_key)
        fitnesses.append(np.asarray(fitness, np.float64).reshape(len(descriptor)))
        descriptors.append(np.asarray(descriptor, np.float64))
    found = np.stack(fitnesses)
    found[~np.isfinite(found)] = -np.inf
    fitness = np.median(found, axis=0)
    middle, known = _middle(found, np.stack(descriptors))
    cells = _cells(middle, archive.centroids)
    best = np.full(len(archive.centroids), -np.inf)
    np.maximum.at(best, cells[known], fitness[known])
    return best


def _filled(archive: Elites) -> np.ndarray:
    """Returns whether a cell holds an individual, (cells,).

    Raises:
        TypeError: ``archive`` is no archive.
        ValueError: It has no elite, or several fitnesses for each.
    """
    if not all(
        hasattr(archive, name) for name in ("genotypes", "fitnesses", "centroids")
    ):
        allowed = "an Archive, or a repertoire of QDax with centroids"
        raise TypeError(message("archive", archive, allowed))
    fitnesses = np.asarray(archive.fitnesses)
    if fitnesses.size != len(fitnesses):
        allowed = "one fitness for each cell"
        raise ValueError(message("archive.fitnesses", fitnesses, allowed))
    filled = np.isfinite(fitnesses.reshape(-1))
    if not filled.any():
        raise ValueError(message("archive", Fact("no elites"), "one or more"))
    return filled


def _middle(
    fitnesses: np.ndarray, descriptors: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the median descriptor of each elite over its sound evaluations.

    Args:
        fitnesses: (K, N) fitnesses of K evaluations.
        descriptors: (K, N, D) their descriptors.

    Returns:
        (N, D) medians, and (N,) whether the elite has a sound evaluation.
    """
    sound = np.isfinite(fitnesses) & np.all(np.isfinite(descriptors), axis=-1)
    known = np.any(sound, axis=0)
    middle = np.median(descriptors, axis=0)
    for elite in np.flatnonzero(known & ~sound.all(axis=0)):
        middle[elite] = np.median(descriptors[sound[:, elite], elite], axis=0)
    return middle, known


def _cells(descriptors: np.ndarray, centroids: np.ndarray) -> np.ndarray:
    """Returns the nearest centroid (N,) of each descriptor, computed as in QDax."""
    from qdax.core.containers.mapelites_repertoire import get_cells_indices

    return np.asarray(
        get_cells_indices(
            jnp.asarray(descriptors, jnp.float32), jnp.asarray(centroids, jnp.float32)
        )
    )
