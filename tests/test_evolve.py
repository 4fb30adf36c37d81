"""The evolution loop on a tiny task: results and evaluation.

The task needs no physics, so that a run takes a fraction of a second;
``test_cli.py`` runs the real one.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_runs import SMALL, PointEnv, compile_once, point_task, reference, run

from newton_qd.qd.config import ConfigError
from newton_qd.qd.run.archive import load_archive
from newton_qd.qd.run.cells import cell_centroids
from newton_qd.qd.run.evolution import evolve
from newton_qd.qd.run.search import Search, SearchError
from newton_qd.qd.scoring.rollout import make_policy, make_scoring_function

__all__ = ["compile_once", "reference"]  # fixtures

# QDax and what it imports warn about their own use of other packages.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


def test_run_improves_and_reports(reference: Path) -> None:
    result = run()
    metrics = result.metrics
    assert result.iteration == SMALL.iterations and result.out is None
    assert np.array_equal(metrics["iteration"], np.arange(13))
    assert np.array_equal(metrics["evaluations"], 16 * np.arange(1, 14))
    assert np.array_equal(metrics["env_steps"], 9 * metrics["evaluations"])
    for name in ("qd_score", "coverage", "max_fitness"):
        assert np.all(np.diff(metrics[name]) >= 0), f"{name} fell"
        assert metrics[name][-1] > metrics[name][0], f"{name} did not improve"
    archive, kept = result.archive, load_archive(reference)
    for name in ("genotypes", "fitnesses", "descriptors", "centroids"):
        assert np.array_equal(getattr(archive, name), getattr(kept, name)), name
    filled = archive.filled
    assert metrics["coverage"][-1] == pytest.approx(100 * filled.mean())
    assert metrics["max_fitness"][-1] == archive.fitnesses.max()
    score = np.sum(archive.fitnesses[filled] + 5.0 * 9)
    assert metrics["qd_score"][-1] == pytest.approx(score, rel=1e-5)


def test_archive_rows_are_what_the_policies_do(reference: Path) -> None:
    archive = load_archive(reference)
    task = point_task(SMALL)
    policy = make_policy(task.env, SMALL.hidden)
    assert archive.genotypes.shape == (16, policy.size)
    score = jax.jit(make_scoring_function(task, policy, SMALL.episode_length))
    key = jax.random.split(jax.random.key(SMALL.seed), 4)[1]
    filled = archive.filled
    fitnesses, descriptors, _ = score(archive.genotypes[filled], key)
    np.testing.assert_allclose(fitnesses, archive.fitnesses[filled], rtol=1e-5)
    np.testing.assert_array_equal(descriptors, archive.descriptors[filled])
    distance = np.abs(descriptors[:, None] - archive.centroids[None]).max(-1)
    assert np.all(distance.min(1) <= 0.125 + 1e-6)
    assert np.all(distance[np.arange(filled.sum()), np.flatnonzero(filled)] < 0.126)


def test_each_generation_has_a_key_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    search = Search(SMALL, point_task(SMALL))
    state, keys, ask = search.advance(search.empty()), [], search._ask

    def propose(*told: Any) -> Any:
        keys.append(str(jax.random.key_data(told[-1])))
        return ask(*told)

    monkeypatch.setattr(search, "_ask", propose)
    for _ in range(3):
        state = search.advance(state)
    first = str(jax.random.key_data(search._drawn.emitter_key))
    assert len({first, *keys}) == 4


def test_metrics_file(reference: Path) -> None:
    lines = (reference / "metrics.csv").read_text().splitlines()
    head = "iteration,evaluations,env_steps,rejected,qd_score,coverage,max_fitness"
    assert lines[0] == head + ",mean_fitness,initial_fitness,qd_gain"
    assert [int(line.split(",")[0]) for line in lines[1:]] == list(range(13))


def test_metrics_see_quality(reference: Path) -> None:
    archive = load_archive(reference)
    rows = np.loadtxt(reference / "metrics.csv", delimiter=",", skiprows=1)
    mean, initial, gain = rows[:, -3:].T
    found = archive.fitnesses[archive.filled]
    np.testing.assert_allclose(mean[-1], found.mean(), rtol=1e-5)
    np.testing.assert_allclose(
        gain[-1], np.maximum(found - initial[0], 0).sum(), rtol=1e-5
    )
    assert np.all(initial == initial[0]) and np.isfinite(initial[0])
    assert np.all(np.diff(gain) >= 0) and gain[-1] > gain[0] >= 0


@pytest.mark.slow
def test_corrected_metrics_are_those_of_the_elites_put_anew(tmp_path: Path) -> None:
    config = SMALL.replace(iterations=2, reevaluations=5)
    result = run(config, out=tmp_path / "run")
    again = result.reevaluated
    assert again is not None
    written = json.loads((tmp_path / "run" / "corrected.json").read_text())
    assert written == dataclasses.asdict(again)
    task = point_task(config)
    policy = make_policy(task.env, config.hidden)
    score = jax.jit(make_scoring_function(task, policy, config.episode_length))
    reset = jax.random.fold_in(jax.random.split(jax.random.key(config.seed), 4)[1], 1)
    genotypes = result.archive.genotypes[result.archive.filled]
    scores = [score(genotypes, key)[:2] for key in jax.random.split(reset, 5)]
    fitness = np.median([np.asarray(f) for f, _ in scores], axis=0)
    found = np.median([np.asarray(d) for _, d in scores], axis=0)
    best: dict[int, float] = {}
    for value, descriptor in zip(fitness, found, strict=True):
        distance = np.square(result.archive.centroids - descriptor).sum(-1)
        cell = int(distance.argmin())
        best[cell] = max(value, best.get(cell, -np.inf))
    assert again.coverage == 100 * len(best) / 16
    assert again.max_fitness == pytest.approx(max(best.values()))
    assert again.qd_score == pytest.approx(sum(best.values()) + 45 * len(best))
    assert run(SMALL.replace(iterations=1)).reevaluated is None


def test_seed_decides() -> None:
    first, again, other = run(), run(), run(SMALL.replace(seed=1))
    assert np.array_equal(first.archive.genotypes, again.archive.genotypes)
    assert not np.array_equal(first.archive.genotypes, other.archive.genotypes)


def test_voronoi_cells() -> None:
    config = SMALL.replace(grid=None, centroids=10, iterations=2)
    first, again = run(config), run(config)
    assert first.archive.centroids.shape == (10, 2)
    assert np.array_equal(first.archive.centroids, again.archive.centroids)
    assert np.array_equal(first.archive.genotypes, again.archive.genotypes)


def test_voronoi_cells_fill_the_limits_of_each_component() -> None:
    config = SMALL.replace(grid=None, centroids=6)
    limits = np.zeros(2, np.float32), np.array([1, 10], np.float32)
    found = np.asarray(cell_centroids(config, limits, jax.random.key(0)))
    assert found[:, 0].max() <= 1 and found[:, 1].max() > 5


def test_default_grid_is_filled_in() -> None:
    config = SMALL.replace(grid=None)
    assert [config.resolve(n).grid for n in (2, 4)] == [(32, 32), (5, 5, 5, 5)]
    assert config.replace(centroids=9).resolve(2).grid is None
    with pytest.raises(
        ConfigError, match=r"grid: got .*descriptor of 5 components.*centroids"
    ):
        config.resolve(5)


@pytest.mark.slow
def test_x64_changes_no_type(x64: None) -> None:
    result = run(SMALL.replace(iterations=2))
    assert result.archive.genotypes.dtype == np.float32
    assert result.metrics["coverage"][-1] > 0


def brute_force(env: PointEnv, act_and_step: Any, genotype: Any, key: Any) -> tuple:
    state = env.reset(key)
    fitness, descriptors, faulty = 0.0, [], False
    for _ in range(SMALL.episode_length):
        descriptors.append(np.asarray(state.info["state_descriptor"]))
        state = act_and_step(state, genotype)
        fitness += float(state.reward)
        faulty |= bool(state.info["fault"])
        if state.done:
            break
    return (-np.inf if faulty else fitness), np.mean(descriptors, axis=0)


def test_scoring_agrees_with_a_plain_loop() -> None:
    task = point_task(SMALL)
    policy = make_policy(task.env, SMALL.hidden)
    draw = jax.jit(jax.vmap(policy.init))
    genotypes = 3 * np.asarray(draw(jax.random.split(jax.random.key(3), 24)))
    key = jax.random.key(4)
    score = jax.jit(make_scoring_function(task, policy, SMALL.episode_length))
    fitnesses, descriptors, _ = score(genotypes, key)

    @jax.jit
    def step(state: Any, genotype: Any) -> Any:
        action = policy.apply(policy.unravel(genotype), state.obs)
        return task.env.step(state, action)

    rows = [brute_force(task.env, step, genotype, key) for genotype in genotypes]
    expected = np.array([row[0] for row in rows])
    assert np.isinf(expected).any() and np.isfinite(expected).sum() > 5
    np.testing.assert_allclose(fitnesses, expected, rtol=1e-4)
    valid = np.isfinite(expected)
    np.testing.assert_allclose(
        descriptors[valid], np.array([row[1] for row in rows])[valid], rtol=1e-6
    )


def test_a_run_in_which_everything_is_faulty_ends() -> None:
    class Faulty(PointEnv):
        fault_beyond = -100.0

    with pytest.raises(SearchError, match="initial population"):
        evolve(
            SMALL,
            progress=False,
            task_factory=lambda config: point_task(config, Faulty()),
        )


@pytest.mark.parametrize(
    ("part", "words"),
    [
        (
            "reward",
            "return is not finite in 16, the descriptor is not finite in 0, "
            "and the physics had a fault in 0",
        ),
        ("descriptor", "return is not finite in 0, the descriptor is not finite in 1"),
    ],
)
def test_a_search_error_says_what_is_not_finite(part: str, words: str) -> None:
    class Undefined(PointEnv):
        def step(self, state: Any, action: Any) -> Any:
            after = super().step(state, action)
            lost = after.reward * (jnp.nan if part == "reward" else 1)
            return dataclasses.replace(after, reward=lost)

    def task(config: Any) -> Any:
        made = point_task(config, Undefined())
        if part == "reward":
            return made
        return dataclasses.replace(
            made, descriptor_extractor=lambda data, mask: data.state_desc[:, 0] / 0 * 0
        )

    with pytest.raises(SearchError, match=words):
        evolve(SMALL, progress=False, task_factory=task)


def test_descriptors_out_of_bounds_go_to_the_nearest_cell() -> None:
    class Narrow(PointEnv):
        pass

    limits = np.full(2, 0.4, np.float32), np.full(2, 0.6, np.float32)
    task = dataclasses.replace(point_task(SMALL, Narrow()), limits=limits)
    config = SMALL.replace(iterations=1)
    archive = evolve(config, progress=False, task_factory=lambda _: task).archive
    filled = archive.filled
    found = archive.descriptors[filled]
    assert np.any((found < 0.4) | (found > 0.6))
    distance = np.square(found[:, None] - archive.centroids).sum(-1)
    np.testing.assert_array_equal(distance.argmin(1), np.flatnonzero(filled))


def test_a_task_can_be_a_static_argument() -> None:
    task = point_task(SMALL)
    twice = jax.jit(lambda task, x: 2 * x, static_argnums=0)
    assert [twice(one, 3) for one in (task, dataclasses.replace(task))] == [6, 6]


def test_wrong_arguments_of_a_policy_are_named() -> None:
    env = point_task(SMALL).env
    for hidden, words in (("ab", "hidden: got 'ab'"), ((4, 0), r"hidden\[1\]: got 0")):
        with pytest.raises((TypeError, ValueError), match=words):
            make_policy(env, hidden)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="env: got 'ant'; allowed: an environment"):
        make_policy("ant", (4,))  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="key: got 3; allowed: one key"):
        make_policy(env, (4,)).init(3)  # type: ignore[arg-type]


def test_genotypes_of_another_policy_are_refused() -> None:
    task = point_task(SMALL)
    policy = make_policy(task.env, SMALL.hidden)
    score = make_scoring_function(task, policy, SMALL.episode_length)
    for shape in ((5, policy.size + 1), (policy.size,)):
        with pytest.raises(
            ValueError, match=rf"genotypes: got shape .* allowed: \(N, {policy.size}\)"
        ):
            jax.eval_shape(score, jnp.zeros(shape), jax.random.key(0))


def test_what_cannot_be_settings_is_named() -> None:
    with pytest.raises(ConfigError, match="config: got 'point'; allowed: an Evolve"):
        evolve("point")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    "sizes",
    [
        {"batch_size": 2_000_000_000},
        {"hidden": (1_000_000, 1_000_000)},
        {"hidden": (100_000,), "grid": (1000, 1000)},
    ],
)
def test_sizes_that_cannot_fit_are_refused(sizes: dict[str, Any]) -> None:
    """Before anything allocates, with the memory that they need."""
    wanted = (
        r"batch_size, hidden, cells: got \(.*, which needs at least [\d.,]+ [GT]B; "
    )
    with pytest.raises(ConfigError, match=f"{wanted}allowed: sizes that fit in the"):
        run(SMALL.replace(**sizes))


def test_elites_are_put_to_a_new_test_only_if_they_are(
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = SMALL.replace(iterations=1, reevaluations=0)
    evolve(config, task_factory=point_task)
    assert "evaluating the elites again" not in capsys.readouterr().err


def test_quiet_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    run()
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err == ""
