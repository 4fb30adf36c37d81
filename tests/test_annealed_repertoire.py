"""The annealed archive against a loop in NumPy and against pyribs'."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import pytest
from qdax.core.containers.mapelites_repertoire import compute_euclidean_centroids
from qdax.core.emitters.emitter import Emitter

from newton_qd.qd.emitters.annealed import OnAnnealedRepertoire
from newton_qd.qd.emitters.annealed_repertoire import AnnealedRepertoire

CELLS = (4, 3)
RATE, FLOOR = 0.3, -0.5

# one program in place of one for each operation
init = jax.jit(
    AnnealedRepertoire.init, static_argnames=("learning_rate", "threshold_min")
)
add = jax.jit(AnnealedRepertoire.add)


def batches(count: int, size: int) -> list[tuple[Any, Any, Any]]:
    """Genotypes (N, 2), descriptors (N, 2) and fitnesses (N,)."""
    rng = np.random.default_rng(0)
    return [
        (
            rng.normal(size=(size, 2)),
            rng.uniform(-0.1, 1.1, size=(size, 2)),
            rng.normal(size=size) + 0.05 * number,
        )
        for number in range(count)
    ]


def cell(descriptor: np.ndarray) -> int:
    """Cell of a descriptor, in QDax's order."""
    x, y = (
        min(max(int(np.floor(c * n)), 0), n - 1)
        for c, n in zip(descriptor, CELLS, strict=True)
    )
    return y * CELLS[0] + x


def repertoire(data: list[tuple[Any, Any, Any]]) -> AnnealedRepertoire:
    """Repertoire of several batches."""
    centroids = compute_euclidean_centroids(CELLS, [0.0, 0.0], [1.0, 1.0])
    genotypes, descriptors, fitnesses = data[0]
    found = init(
        *(genotypes, fitnesses, descriptors, centroids, {}),
        learning_rate=RATE,
        threshold_min=FLOOR,
    )
    for batch in data[1:]:
        found = add(found, *batch)
    return found


@pytest.mark.parametrize("size", [1, 20])
def test_thresholds_and_elites(size: int, x64: None) -> None:
    data = batches(40, size)
    found = repertoire(data)
    thresholds = np.full(12, FLOOR)
    fitnesses, best = np.full(12, -np.inf), np.full(12, -np.inf)
    genotypes = np.zeros((12, 2))
    for batch in data:
        entering: dict[int, list[int]] = {}
        for index, (descriptor, f) in enumerate(zip(*batch[1:], strict=True)):
            where = cell(descriptor)
            best[where] = max(best[where], f)
            if f > thresholds[where]:
                entering.setdefault(where, []).append(index)
        for where, indices in entering.items():
            f = batch[2][indices]
            # One after the other, each of the mean fitness.
            for _ in indices:
                thresholds[where] = (1 - RATE) * thresholds[where] + RATE * f.mean()
            fitnesses[where] = f.max()
            genotypes[where] = batch[0][indices[int(np.argmax(f))]]
    np.testing.assert_allclose(found.thresholds, thresholds, rtol=1e-12)
    np.testing.assert_array_equal(found.fitnesses[:, 0], fitnesses)
    np.testing.assert_array_equal(found.genotypes, genotypes)
    np.testing.assert_array_equal(found.result.fitnesses[:, 0], best)
    assert np.any(best > fitnesses), "the annealed archive has forgotten nothing"


@pytest.mark.slow
def test_agrees_with_pyribs(x64: None) -> None:
    pytest.importorskip("ribs")
    from ribs.archives import GridArchive

    data = batches(20, 20)
    found = repertoire(data)
    archive = GridArchive(
        solution_dim=2,
        dims=CELLS,
        ranges=[(0, 1)] * 2,
        learning_rate=RATE,
        threshold_min=FLOOR,
    )
    for genotypes, descriptors, fitnesses in data:
        archive.add(genotypes, fitnesses, descriptors)
    held = archive.data()
    cells = [cell(measures) for measures in held["measures"]]
    assert len(cells) == 12
    np.testing.assert_allclose(np.asarray(found.thresholds)[cells], held["threshold"])
    np.testing.assert_array_equal(np.asarray(found.genotypes)[cells], held["solution"])


class Watching(Emitter):
    """Its state is the archive that it was shown last."""

    batch_size: Any = 12
    init: Any = staticmethod(lambda key, repertoire, *rest: repertoire)
    emit: Any = staticmethod(lambda repertoire, state, key: (repertoire.genotypes, {}))
    state_update: Any = staticmethod(lambda state, repertoire, *rest: repertoire)


def test_an_emitter_is_shown_the_annealed_archive(x64: None) -> None:
    first, second = batches(2, 20)
    emitter = OnAnnealedRepertoire(Watching(), learning_rate=RATE, threshold_min=FLOOR)
    loop, expected = repertoire([first]), repertoire([first, second])
    genotypes, descriptors, fitnesses = first
    begun = jax.jit(emitter.init)(
        jax.random.key(0), loop.result, genotypes, fitnesses, descriptors, {}
    )
    genotypes, descriptors, fitnesses = second
    after = jax.jit(emitter.state_update)(
        begun, None, genotypes, fitnesses, descriptors, {}
    )
    for shown, held in ((begun, loop), (after, expected)):
        for found in (shown.emitter, shown.repertoire):
            np.testing.assert_array_equal(found.thresholds, held.thresholds)
        emitted, _ = emitter.emit(None, shown, jax.random.key(0))
        np.testing.assert_array_equal(emitted, held.genotypes)


def test_what_is_not_finite_never_enters() -> None:
    bad = np.array([np.nan, np.inf, 1.0, 2.0, -np.inf])
    descriptors = np.full((5, 2), 0.1)
    descriptors[2] = np.nan
    found = repertoire([(np.ones((5, 2)), descriptors, bad)])
    for held in (found, found.result):
        fitnesses = np.asarray(held.fitnesses)[:, 0]
        filled = fitnesses > -np.inf
        assert np.flatnonzero(filled).tolist() == [cell(np.array([0.1, 0.1]))]
        assert fitnesses[filled].tolist() == [2.0]
    assert np.all(np.isfinite(found.thresholds))


def test_with_rate_one_the_threshold_is_the_mean_of_what_enters() -> None:
    found = init(
        np.zeros((4, 1), np.float32),
        np.array([1, 2, 6, -2], np.float32),
        np.full((4, 1), 0.1, np.float32),
        np.array([[0.25], [0.75]], np.float32),
        learning_rate=1.0,
        threshold_min=-1.0,
    )
    np.testing.assert_array_equal(found.thresholds, [3, -1])


def test_both_archives_can_be_donated() -> None:
    """What is in both of them would be one buffer, without jit."""

    def begin(*given: Any) -> AnnealedRepertoire:
        return AnnealedRepertoire.init(*given, learning_rate=RATE, threshold_min=FLOOR)

    one = np.ones((1, 2), np.float32)
    leaves = jax.make_jaxpr(begin)(one, one[0, :1], one, one).jaxpr.outvars
    assert len({id(leaf) for leaf in leaves}) == len(leaves)


def test_a_fitness_at_the_threshold_does_not_enter() -> None:
    fitness = np.array([FLOOR])
    found = repertoire([(np.ones((1, 2)), np.full((1, 2), 0.1), fitness)])
    assert not (np.asarray(found.fitnesses) > -np.inf).any()
    assert (np.asarray(found.result.fitnesses) == FLOOR).sum() == 1


def test_whole_fitnesses_do_not_round_thresholds() -> None:
    one = np.ones((1, 2), np.float32)
    found = init(
        one, np.ones(1, np.int32), one, one, learning_rate=0.5, threshold_min=-0.5
    )
    assert found.thresholds.tolist() == [0.25]


def test_the_first_of_equally_fit_individuals_enters() -> None:
    """All of them would be written to one row, on a GPU in no defined order."""
    genotypes = np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]])
    descriptors = np.array([[0.11, 0.1], [0.1, 0.1], [0.12, 0.1]])
    found = repertoire([(genotypes, descriptors, np.array([0.5, 2.0, 2.0]))])
    for archive in (found, found.result):
        fitnesses = np.asarray(archive.fitnesses)[:, 0]
        (cell,) = np.flatnonzero(fitnesses > -np.inf)
        assert np.asarray(archive.genotypes)[cell].tolist() == [2, 2]
        assert fitnesses[cell] == 2


@pytest.mark.parametrize(
    ("rate", "floor", "message"),
    [
        (1.5, 0.0, "learning_rate: got 1.5; .* from 0 to 1"),
        (0.1, -np.inf, "threshold_min: got -inf; allowed: finite"),
    ],
)
def test_refuses(rate: float, floor: float, message: str) -> None:
    given: Any = np.zeros((1, 2)), np.zeros(1), np.zeros((1, 2)), np.zeros((4, 2))
    with pytest.raises(ValueError, match=message):
        AnnealedRepertoire.init(*given, learning_rate=rate, threshold_min=floor)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"genotypes": np.zeros((0, 2))}, r"genotypes: got .*\(0, 2\).* at least 1"),
        ({"fitnesses": np.zeros(2)}, r"fitnesses: got .* \(2,\), .* with N = 3, as"),
        # JAX would use its one component for both
        ({"descriptors": np.zeros((3, 1))}, r"descriptors: got .* D\) = \(3, 2\)"),
        ({"centroids": np.zeros(4)}, r"centroids: got .* \(4,\), .* \(cells, D\)"),
    ],
)
def test_refuses_other_shapes(changes: dict[str, Any], message: str) -> None:
    given: dict[str, Any] = {
        "genotypes": np.zeros((3, 2)),
        "fitnesses": np.zeros((3, 1)),
        "descriptors": np.zeros((3, 2)),
        "centroids": np.zeros((4, 2)),
    }
    with pytest.raises(ValueError, match=message):
        AnnealedRepertoire.init(**given | changes, learning_rate=0.1, threshold_min=0.0)
    given["fitnesses"] = [1.0]
    with pytest.raises(TypeError, match=r"fitnesses: got \[1.0\]; allowed: an array"):
        AnnealedRepertoire.init(**given, learning_rate=0.1, threshold_min=0.0)


def test_adding_nothing_changes_nothing() -> None:
    before = init(
        *(np.zeros((3, 2)), np.zeros(3), np.zeros((3, 2)), np.eye(2)),
        learning_rate=0.1,
        threshold_min=0.0,
    )
    after = add(before, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    np.testing.assert_array_equal(after.thresholds, before.thresholds)
    np.testing.assert_array_equal(after.fitnesses, before.fitnesses)
