"""pyribs with these tasks: evaluation for its schedulers, conversion of archives."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.envs.inputs import require_key
from newton_qd.errors import require_extra
from newton_qd.real_numbers import real_numbers
from newton_qd.types import Repertoire, ScoringFunction

if TYPE_CHECKING:
    from qdax.core.containers.mapelites_repertoire import MapElitesRepertoire
    from ribs.archives import CVTArchive, GridArchive

Limits = tuple[np.ndarray, np.ndarray]


def make_ribs_evaluation(
    score: ScoringFunction,
    key: jax.Array,
    *,
    limits: Limits,
    worst: float,
    jacobian: bool = False,
) -> Callable[[np.ndarray], tuple[np.ndarray, ...]]:
    """Makes the function between ``ask`` and ``tell`` of a ``ribs`` scheduler.

    Use it as ``scheduler.tell(*evaluate(scheduler.ask()))``, or with ``jacobian`` as
    ``scheduler.tell_dqd(*evaluate(scheduler.ask_dqd()))``. One call evaluates the whole
    batch in one jitted function, which is compiled once for each batch size.

    Args:
        score: Result of ``make_scoring_function``. With ``jacobian``: result of
            ``Episode.scoring``, which also returns ``"gradients"`` (N, size, 1 + D),
            first of the fitness, then of each descriptor, not normalized. An individual
            counts as faulty if a value is not finite.
        key: Key for the resets.
        limits: Lowest and highest descriptor, (D,) each, as in ``Task.limits``.
        worst: Objective of a faulty individual, because pyribs does not allow infinite
            objectives. ``-task.qd_offset(episode_length)`` adds 0 to the QD score.
            The measures of a faulty individual are the lowest ones, its gradients 0.
        jacobian: Whether to return gradients too.

    Returns:
        Function of solutions (N, size) that returns objectives (N,), measures (N, D)
        and, with ``jacobian``, gradients (N, 1 + D, size).

    Raises:
        TypeError: ``score`` is not a function, ``key`` is not a key, or ``limits`` are
            not two vectors.
        ValueError: ``key`` is several keys, ``worst`` is not finite, or a highest
            descriptor is not above the lowest one. The returned function raises
            ``GradientsError`` if gradients are missing or have the wrong shape, and
            ``ValueError`` if the solutions are no matrix or the limits do not have the
            shape of a descriptor.
    """
    checks.function("score", score, "a function of genotypes and a key")
    require_key("key", key)
    checks.number("worst", worst)
    low = jnp.asarray(_limits(limits)[0], jnp.float32)

    @jax.jit
    def run(genotypes: jax.Array) -> tuple[jax.Array, ...]:
        fitnesses, descriptors, extra = score(genotypes, key)
        if low.shape != descriptors.shape[1:]:
            given = Fact(f"arrays of shape {low.shape}")
            allowed = f"arrays of shape {descriptors.shape[1:]}"
            raise ValueError(message("limits", given, allowed))
        good = jnp.isfinite(fitnesses) & jnp.isfinite(descriptors).all(axis=1)
        rows: tuple[jax.Array, ...] = ()
        if jacobian:
            from newton_qd.qd.scoring.gradient_scores import read_scores

            scores = read_scores(genotypes, fitnesses, descriptors, extra)
            good, rows = scores.finite, (scores.gradients,)
        objectives = jnp.where(good, fitnesses, worst)
        return objectives, jnp.where(good[:, None], descriptors, low), *rows

    def evaluate(solutions: np.ndarray) -> tuple[np.ndarray, ...]:
        found = real_numbers(solutions)
        if found is None or found.ndim != 2:
            allowed = "numbers, an array of shape (N, size)"
            raise ValueError(message("solutions", solutions, allowed))
        results = run(jnp.asarray(found, jnp.float32))
        # copies, because pyribs normalizes the gradients in place
        return tuple(np.array(result) for result in results)

    return evaluate


def to_ribs(
    repertoire: Repertoire, limits: Limits, grid: tuple[int, ...] | None = None
) -> CVTArchive | GridArchive:
    """Makes a ``ribs`` archive with the elites of a repertoire.

    pyribs computes the cell of each elite from its measures. At the border of cells,
    two elites may get the same cell. Then the fitter one stays.

    Args:
        repertoire: ``MapElitesRepertoire`` of QDax, or ``Archive`` of ``evolve``.
        limits: Lowest and highest descriptor, (D,) each.
        grid: Cells along each dimension, if the cells are a grid.

    Returns:
        ``GridArchive`` if ``grid`` is given, else ``CVTArchive`` with the centroids
        of the repertoire.

    Raises:
        MissingExtra: pyribs is not installed.
        TypeError: ``repertoire`` has no centroids, ``limits`` are not two vectors, or
            ``grid`` is not a tuple of integers.
        ValueError: A highest descriptor is not above the lowest one, ``grid`` does not
            have as many cells as the repertoire, or a fitness is NaN.
    """
    require_extra("ribs", "ribs")
    from ribs.archives import CVTArchive, GridArchive

    if not hasattr(repertoire, "centroids"):
        raise TypeError(message("repertoire", repertoire, "an archive with centroids"))
    centroids = np.asarray(repertoire.centroids)
    limits = _limits(limits, centroids.shape[1])
    if grid is not None:
        _check_grid(grid, *centroids.shape)
    ravel = jax.vmap(lambda genotype: ravel_pytree(genotype)[0])
    solutions = np.asarray(ravel(jax.tree.map(jnp.asarray, repertoire.genotypes)))
    common: Any = {
        "solution_dim": solutions.shape[1],
        "ranges": list(zip(*limits, strict=True)),
        "dtype": solutions.dtype,
    }
    if grid is None:
        archive = CVTArchive(centroids=centroids, **common)
    else:
        archive = GridArchive(dims=grid, **common)
    objectives = np.asarray(repertoire.fitnesses).reshape(len(centroids))
    _refuse_nan("repertoire.fitnesses", objectives)
    filled = np.isfinite(objectives)
    if filled.any():
        measures = np.asarray(repertoire.descriptors)[filled]
        archive.add(solutions[filled], objectives[filled], measures)
    return archive


def from_ribs(archive: CVTArchive | GridArchive) -> MapElitesRepertoire:
    """Makes QDax's repertoire from a ``ribs`` archive, cell by cell.

    Args:
        archive: ``GridArchive`` or ``CVTArchive`` of pyribs.

    Returns:
        ``MapElitesRepertoire`` with flat genotypes; its cells are in the order of the
        archive's indices.

    Raises:
        MissingExtra: QDax or pyribs is not installed.
        TypeError: The archive is another one, or its solutions are not vectors.
        ValueError: An objective is NaN, or too large for float32.
    """
    require_extra("qdax", "qd")
    require_extra("ribs", "ribs")
    from qdax.core.containers.mapelites_repertoire import MapElitesRepertoire

    centroids = _centroids(archive)
    data = archive.data(["solution", "objective", "measures", "index"])
    _refuse_nan("objectives of archive", np.asarray(data["objective"]))
    index = np.asarray(data["index"], np.int64)
    cells = len(centroids)
    genotypes = np.zeros((cells, cast("int", archive.solution_dim)), np.float32)
    fitnesses = np.full((cells, 1), -np.inf, np.float32)
    descriptors = np.zeros(centroids.shape, np.float32)
    _refuse_large("objectives of archive", np.asarray(data["objective"]))
    genotypes[index] = data["solution"]
    fitnesses[index, 0] = data["objective"]
    descriptors[index] = data["measures"]
    return MapElitesRepertoire(
        genotypes=jnp.asarray(genotypes),
        fitnesses=jnp.asarray(fitnesses),
        extra_scores={},
        keys_extra_scores=(),
        descriptors=jnp.asarray(descriptors),
        centroids=jnp.asarray(centroids, jnp.float32),
    )


def _limits(limits: Any, length: int | None = None) -> Limits:
    """Returns lowest and highest descriptor as vectors.

    Args:
        limits: Lowest and highest descriptor, (D,) each.
        length: D; ``None``: any.

    Raises:
        TypeError: They are not two vectors of numbers.
        ValueError: They have another length, or a highest descriptor is not above the
            lowest one.
    """
    allowed = f"lowest and highest descriptor, ({length or 'D'},) each"
    try:
        low, high = (np.asarray(limit, np.float64) for limit in limits)
    except (TypeError, ValueError):
        raise TypeError(message("limits", limits, allowed)) from None
    if low.ndim != 1 or low.shape != high.shape or length not in (None, len(low)):
        given = Fact(f"arrays of shape {low.shape} and {high.shape}")
        raise ValueError(message("limits", given, allowed))
    if not (np.isfinite([low, high]).all() and (high > low).all()):
        allowed = "finite numbers, the highest above the lowest"
        raise ValueError(message("limits", (low.tolist(), high.tolist()), allowed))
    return low, high


def _check_grid(grid: Any, cells: int, dimensions: int) -> None:
    """Checks that a grid has the cells of a repertoire.

    Args:
        grid: Cells along each dimension.
        cells: Number of cells of the repertoire.
        dimensions: Length of a descriptor.

    Raises:
        TypeError: It is not a tuple.
        ValueError: It has other entries, or another number of cells.
    """
    checks.instance("grid", grid, (tuple, list), "a tuple of integers", optional=True)
    for index, along in enumerate(grid):
        checks.integer(f"grid[{index}]", along)
    number = math.prod(grid)
    if len(grid) != dimensions or number != cells:
        allowed = f"{dimensions} integers with a product of {cells}"
        why = f"which has {number} cells"
        raise ValueError(message("grid", grid, allowed, why=why))


def _refuse_nan(name: str, values: np.ndarray) -> None:
    """Refuses NaN: it is neither better nor worse than another number.

    Raises:
        ValueError: A value is NaN.
    """
    count = int(np.isnan(values).sum())
    if count:
        given = Fact(f"NaN in {count} of {values.size} cells")
        raise ValueError(message(name, given, "numbers; -inf in empty cells"))


def _refuse_large(name: str, values: np.ndarray) -> None:
    """Refuses numbers that would be infinite as float32, and their cells empty.

    Raises:
        ValueError: A finite value is one.
    """
    largest = float(np.finfo(np.float32).max)
    large = values[np.isfinite(values) & (np.abs(values) > largest)]
    if large.size:
        allowed = f"from {-largest:.3g} to {largest:.3g}"
        raise ValueError(message(name, float(large[0]), allowed))


def _centroids(archive: Any) -> np.ndarray:
    """(cells, D) centres of the cells, in the order of their indices.

    Raises:
        TypeError: The archive is another one, or its solutions are not vectors.
    """
    from ribs.archives import CVTArchive, GridArchive

    # Other archives may have grid indices too, but their cells move.
    if not isinstance(archive, CVTArchive | GridArchive):
        given = Fact(type(archive).__name__)
        raise TypeError(message("archive", given, "GridArchive, CVTArchive"))
    checks.integer(
        "archive.solution_dim", archive.solution_dim, most=None, error=TypeError
    )
    if isinstance(archive, CVTArchive):
        return np.asarray(archive.centroids)
    index = archive.int_to_grid_index(np.arange(archive.cells))
    fraction = (index + 0.5) / archive.dims
    return archive.lower_bounds + fraction * archive.interval_size
