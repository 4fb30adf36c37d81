"""pyribs: its schedulers evaluated here, its archives converted both ways."""

from __future__ import annotations

import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_runs import SMALL, PointEnv, point_task, run

from newton_qd.errors import MissingExtra
from newton_qd.qd.emitters import GradientsError
from newton_qd.qd.scoring.ribs import from_ribs, make_ribs_evaluation, to_ribs
from newton_qd.qd.scoring.rollout import make_policy, make_scoring_function

LIMITS = (np.zeros(2), np.ones(2))
WORST = -5.0 * SMALL.episode_length


@pytest.mark.slow
def test_a_scheduler_evolves_policies() -> None:
    from ribs.archives import GridArchive
    from ribs.emitters import EvolutionStrategyEmitter
    from ribs.schedulers import Scheduler

    task = point_task(SMALL)
    policy = make_policy(task.env, SMALL.hidden)
    score = make_scoring_function(task, policy, SMALL.episode_length)
    traced = []

    def counted(genotypes: Any, key: Any) -> Any:
        traced.append(genotypes.shape)
        return score(genotypes, key)

    evaluate = make_ribs_evaluation(
        counted, jax.random.key(0), limits=task.limits, worst=WORST
    )
    archive = GridArchive(
        solution_dim=policy.size, dims=(4, 4), ranges=[(0, 1), (0, 1)], seed=1
    )
    start = np.asarray(policy.init(jax.random.key(1)))
    emitters = [
        EvolutionStrategyEmitter(
            archive, x0=start, sigma0=0.3, batch_size=16, seed=seed
        )
        for seed in (1, 2)
    ]
    scheduler = Scheduler(archive, emitters)
    objectives, measures = evaluate(scheduler.ask())
    assert type(objectives) is np.ndarray and measures.shape == (32, 2)
    scheduler.tell(objectives, measures)
    first = archive.stats
    for _ in range(10):
        scheduler.tell(*evaluate(scheduler.ask()))
    assert archive.stats.coverage > first.coverage
    best: Any = archive.stats.obj_max
    assert best > first.obj_max
    assert traced == [(32, policy.size)]


def test_faulty_individuals_have_the_worst_objective() -> None:
    class Faulty(PointEnv):
        fault_beyond = -100.0

    task = point_task(SMALL, Faulty())
    policy = make_policy(task.env, SMALL.hidden)
    score = make_scoring_function(task, policy, SMALL.episode_length)
    key = jax.random.key(0)
    evaluate = make_ribs_evaluation(score, key, limits=task.limits, worst=WORST)
    objectives, measures = evaluate(np.ones((3, policy.size)))
    np.testing.assert_array_equal(objectives, WORST)
    np.testing.assert_array_equal(measures, 0.0)
    with pytest.raises(ValueError, match="worst: got -inf; allowed: finite number"):
        make_ribs_evaluation(score, key, limits=LIMITS, worst=-np.inf)
    wrong: Any = 0
    with pytest.raises(TypeError, match=r"^key: got 0; allowed: one key"):
        make_ribs_evaluation(score, wrong, limits=LIMITS, worst=-1.0)
    with pytest.raises(ValueError, match=r"^solutions: got .*; allowed: numbers"):
        evaluate(np.full((2, 3), "a"))


def test_what_pyribs_would_refuse_counts_as_faulty() -> None:
    descriptors = jnp.array([[0.5, 0.5], [0.5, jnp.nan], [0.5, 0.5]])
    gradients = jnp.ones((3, 4, 3)).at[2, 1, 0].set(jnp.inf)

    def score(genotypes: jax.Array, key: jax.Array) -> Any:
        return jnp.ones(3), descriptors, {"gradients": gradients}

    low, high = np.array([-1.0, -2.0]), np.ones(2)
    common: dict[str, Any] = {"limits": (low, high), "worst": -100.0}
    solutions, key = np.zeros((3, 4)), jax.random.key(0)
    plain = make_ribs_evaluation(score, key, **common)(solutions)
    np.testing.assert_array_equal(plain[0], [1, -100, 1])
    np.testing.assert_array_equal(plain[1], [[0.5, 0.5], low, [0.5, 0.5]])
    dqd = make_ribs_evaluation(score, key, jacobian=True, **common)(solutions)
    np.testing.assert_array_equal(dqd[0], [1, -100, -100])
    np.testing.assert_array_equal(dqd[2].any(axis=(1, 2)), [True, False, False])
    assert dqd[2].flags.writeable  # pyribs normalizes them in place

    def without(genotypes: jax.Array, key: jax.Array) -> Any:
        return jnp.ones(3), descriptors, {}

    with pytest.raises(ValueError, match=r"solutions: got .*; allowed: .*\(N, size\)"):
        make_ribs_evaluation(score, key, **common)(solutions[0])
    evaluate = make_ribs_evaluation(without, key, jacobian=True, **common)
    with pytest.raises(GradientsError, match=r"'gradients' is missing"):
        evaluate(solutions)


@pytest.mark.slow
def test_gradients_reach_the_scheduler() -> None:
    from ribs.archives import GridArchive
    from ribs.emitters import GradientArborescenceEmitter
    from ribs.schedulers import Scheduler

    def one(x: jax.Array) -> jax.Array:
        descriptor = jax.nn.sigmoid(jnp.stack([x[:3].sum(), x[3:].sum()]))
        return jnp.concatenate([-jnp.sum(jnp.square(x - 1.0))[None], descriptor])

    def score(genotypes: jax.Array, key: jax.Array) -> Any:
        del key
        values = jax.vmap(one)(genotypes)
        gradients = jax.vmap(jax.jacrev(one))(genotypes)
        return values[:, 0], values[:, 1:], {"gradients": jnp.swapaxes(gradients, 1, 2)}

    common: dict[str, Any] = {"limits": LIMITS, "worst": -100.0}
    key = jax.random.key(0)
    evaluate = make_ribs_evaluation(score, key, **common)
    evaluate_dqd = make_ribs_evaluation(score, key, jacobian=True, **common)
    archive = GridArchive(solution_dim=6, dims=(8, 8), ranges=[(0, 1), (0, 1)], seed=1)
    emitter = GradientArborescenceEmitter(
        archive, x0=np.zeros(6), sigma0=0.1, lr=0.1, batch_size=8, seed=2
    )
    scheduler = Scheduler(archive, [emitter])
    best = []
    for _ in range(20):
        scheduler.tell_dqd(*evaluate_dqd(scheduler.ask_dqd()))
        scheduler.tell(*evaluate(scheduler.ask()))
        best.append(archive.stats.obj_max)
    assert best[-1] > best[0] and archive.stats.num_elites > 10
    jacobian = evaluate_dqd(np.zeros((2, 6)))[2]
    np.testing.assert_allclose(jacobian[:, 0], 2.0)
    assert jacobian.shape == (2, 3, 6)


# --- archives --------------------------------------------------------------


@pytest.fixture(scope="module")
def individuals() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    return (
        random.normal(size=(40, 5)).astype(np.float32),
        random.normal(size=40).astype(np.float32),
        random.uniform(size=(40, 2)).astype(np.float32),
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["grid", "cvt"])
def test_archives_survive_the_way_there_and_back(kind: str, individuals: Any) -> None:
    from ribs.archives import CVTArchive, GridArchive

    ranges = [(0.0, 1.0), (-1.0, 2.0)]
    limits = (np.array([0.0, -1.0]), np.array([1.0, 2.0]))
    common: Any = {"solution_dim": 5, "ranges": ranges, "dtype": np.float32}
    if kind == "grid":
        archive, grid = GridArchive(dims=(4, 6), **common), (4, 6)
    else:
        archive, grid = CVTArchive(centroids=24, seed=3, samples=500, **common), None
    archive.add(*individuals)
    repertoire = from_ribs(archive)
    assert repertoire.fitnesses.shape == (24, 1)
    back = to_ribs(repertoire, limits, grid)
    before, after = (
        a.data(["index", "solution", "objective", "measures"]) for a in (archive, back)
    )
    for name in before:
        left, right = np.argsort(before["index"]), np.argsort(after["index"])
        np.testing.assert_array_equal(before[name][left], after[name][right])
    # QDax, too, finds the individuals in these cells.
    again = type(repertoire).init(
        *(jnp.asarray(individuals[i]) for i in (0, 1, 2)), repertoire.centroids
    )
    np.testing.assert_array_equal(again.fitnesses, repertoire.fitnesses)
    np.testing.assert_array_equal(again.genotypes, repertoire.genotypes)


def test_cells_of_a_grid_keep_their_elites() -> None:
    from ribs.archives import GridArchive

    ranges: Any = [(0.0, 1.0), (-1.0, 2.0)]
    archive = GridArchive(solution_dim=2, dims=(2, 3), ranges=ranges, dtype=np.float32)
    measures = np.array([[0.75, -0.5], [0.25, 1.5]], np.float32)  # of cells 3 and 2
    archive.add(np.array([[1, 2], [3, 4]]), np.array([5, 6]), measures)
    repertoire = from_ribs(archive)
    centroids = [[x, y] for x in (0.25, 0.75) for y in (-0.5, 0.5, 1.5)]
    np.testing.assert_allclose(repertoire.centroids, centroids)
    filled = np.isfinite(repertoire.fitnesses[:, 0])
    assert np.flatnonzero(filled).tolist() == [2, 3]
    assert np.asarray(repertoire.genotypes)[2:4].tolist() == [[3, 4], [1, 2]]
    limits = (np.array([0.0, -1.0]), np.array([1.0, 2.0]))
    back = to_ribs(repertoire, limits, (2, 3)).data(
        ["index", "solution", "objective", "measures"]
    )
    order = np.argsort(back["index"])
    assert back["index"][order].tolist() == [2, 3]
    assert back["solution"][order].tolist() == [[3, 4], [1, 2]]
    assert back["objective"][order].tolist() == [6, 5]
    np.testing.assert_array_equal(back["measures"][order], measures[::-1])


@pytest.mark.slow
def test_what_evolve_has_found_becomes_a_ribs_archive() -> None:
    result = run(SMALL.replace(iterations=2))
    for grid in (None, (4, 4)):
        archive = to_ribs(result.archive, LIMITS, grid)
        assert archive.stats.obj_max == result.archive.fitnesses.max()
        assert 0 < len(archive) <= result.archive.filled.sum()
    with pytest.raises(ValueError, match=r"grid: got \(3, 4\), .* 12 cells.* of 16"):
        to_ribs(result.archive, LIMITS, (3, 4))


@pytest.mark.parametrize(
    ("limits", "grid", "error", "text"),
    [
        (None, None, TypeError, r"limits: got None; allowed: lowest and highest"),
        ((0.0, 1.0), None, ValueError, r"limits: got arrays of shape \(\) and \(\);"),
        (([0] * 3, [1] * 3), None, ValueError, r"\(3,\); allowed: .* \(2,\) each"),
        (([0, 1], [1, 1]), None, ValueError, r"\[1.0, 1.0\]\); allowed: .* above the"),
        (LIMITS, 16, TypeError, r"grid: got 16; allowed: None, or a tuple of integers"),
        (LIMITS, (4.0, 4), ValueError, r"grid\[0\]: got 4.0; allowed: integers from 1"),
        (LIMITS, (16,), ValueError, r"grid: got \(16,\), .*; allowed: 2 integers with"),
    ],
)
def test_wrong_limits_and_grids(limits: Any, grid: Any, error: Any, text: str) -> None:
    from ribs.archives import GridArchive

    empty = from_ribs(GridArchive(solution_dim=2, dims=(4, 4), ranges=[(0, 1)] * 2))
    with pytest.raises(error, match=text):
        to_ribs(empty, limits, grid)


def test_what_cannot_be_converted(monkeypatch: pytest.MonkeyPatch) -> None:
    from ribs.archives import (
        GridArchive,
        ProximityArchive,
        SlidingBoundariesArchive,
    )

    archive: Any = ProximityArchive(
        solution_dim=2, measure_dim=2, k_neighbors=1, novelty_threshold=0.1
    )
    with pytest.raises(TypeError, match="archive: got ProximityArchive; allowed: Gr"):
        from_ribs(archive)
    ranges: Any = [(0, 1), (0, 1)]
    sliding: Any = SlidingBoundariesArchive(solution_dim=2, dims=(4, 4), ranges=ranges)
    with pytest.raises(TypeError, match="archive: got SlidingBoundariesArchive; al"):
        from_ribs(sliding)
    matrices = GridArchive(solution_dim=(2, 3), dims=(4, 4), ranges=ranges)
    with pytest.raises(
        TypeError, match=r"solution_dim: got \(2, 3\); allowed: integer"
    ):
        from_ribs(matrices)
    broken = GridArchive(solution_dim=2, dims=(4, 4), ranges=ranges)
    broken.add(np.zeros((1, 2)), np.zeros(1), np.zeros((1, 2)))
    nothing = from_ribs(broken)
    damaged = nothing.replace(fitnesses=nothing.fitnesses.at[3].set(np.nan))
    with pytest.raises(ValueError, match="fitnesses: got NaN in 1 of 16 cells; allow"):
        to_ribs(damaged, LIMITS, (4, 4))
    read = broken.data(["solution", "objective", "measures", "index"])
    monkeypatch.setattr(
        broken, "data", lambda names: {**read, "objective": np.full(1, np.nan)}
    )
    with pytest.raises(ValueError, match="objectives of archive: got NaN in 1 of 1"):
        from_ribs(broken)
    monkeypatch.setitem(sys.modules, "ribs", None)
    with pytest.raises(MissingExtra, match=r"newton_qd\[ribs\]"):
        to_ribs(None, LIMITS)


def test_an_objective_that_float32_cannot_hold_is_refused() -> None:
    """Its cell would have the fitness inf, which counts as empty."""
    from ribs.archives import GridArchive

    ranges: Any = [(0, 1), (0, 1)]
    archive = GridArchive(solution_dim=2, dims=(4, 4), ranges=ranges)
    archive.add(np.zeros((1, 2)), np.full(1, 1e300), np.zeros((1, 2)))
    with pytest.raises(
        ValueError, match=r"objectives of archive: got 1e\+300; allowed"
    ):
        from_ribs(archive)


def test_an_evaluation_needs_a_scoring_function() -> None:
    wrong: Any = 7
    with pytest.raises(TypeError, match="score: got 7; allowed: a function of genotyp"):
        make_ribs_evaluation(wrong, jax.random.key(0), limits=LIMITS, worst=WORST)
