"""Evaluations from several start states, and in worlds with random parameters."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_runs import SMALL, compile_once, interrupt_after, point_task, run

import newton_qd
from newton_qd.qd import (
    EvolveConfig,
    Scatter,
    load_run,
    make_policy,
    make_scoring_function,
    robust_scoring,
)
from newton_qd.qd.config import ConfigError
from newton_qd.qd.run.generation_parts import Drawn, GenerationParts
from newton_qd.qd.run.search import Search
from newton_qd.qd.scoring.scatter import scatter_of
from newton_qd.wrappers import RandomParamsWrapper

__all__ = ["compile_once"]  # fixtures

# QDax and what it imports warn about their own use of other packages.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

KEY = jax.random.key(3)


def some_scores(genotypes: jax.Array, key: jax.Array) -> Any:
    """Scores with known gradients (N, 2, 1 + 2), transitions, and a fault."""
    shift = jax.random.normal(key, (3,), jnp.float32)
    rows = jnp.sin(genotypes[:, :1] * (1 + shift) + genotypes[:, 1:])
    gradients = jax.vmap(
        jax.jacrev(lambda x: jnp.sin(x[0] * (1 + shift) + x[1])), 0, 0
    )(genotypes)
    faulty = (genotypes[:, 0] > 5) & (shift[1] > 0)
    return (
        jnp.where(faulty, -jnp.inf, rows[:, 0]),
        rows[:, 1:],
        {
            "gradients": jnp.moveaxis(gradients, 1, -1),
            "normalized_grads": jnp.zeros_like(jnp.moveaxis(gradients, 1, -1)),
            "faulty": faulty,
            "overflowed": jnp.zeros(rows.shape, bool),
            "transitions": {"obs": rows[:, None] + jnp.arange(2.0)[:, None]},
        },
    )


@pytest.mark.parametrize("starts", [3, 4])
@pytest.mark.parametrize("statistic", ["mean", "median"])
@pytest.mark.parametrize("scatter", [None, Scatter(width=0.7, offset=2.0)])
def test_results_are_joined(
    starts: int, statistic: str, scatter: Scatter | None
) -> None:
    genotypes = jnp.asarray([[0.3, 0.1], [1.2, -0.7], [9.0, 0.0]], jnp.float32)
    settings: Any = {"starts": starts, "statistic": statistic, "scatter": scatter}
    score = jax.jit(robust_scoring(some_scores, **settings))
    fitness, found, extra = score(genotypes, KEY)
    alone = jax.jit(some_scores)
    each = [alone(genotypes, key) for key in jax.random.split(KEY, starts)]
    rows = np.stack([np.column_stack([f, d]) for f, d, _ in each])
    function = np.mean if statistic == "mean" else np.median
    bad = np.isneginf(rows[..., 0]).any(axis=0)
    assert bad.tolist() == [False, False, True] == extra["faulty"].tolist()
    expected = function(rows[:, :2], axis=0)
    if scatter is not None:
        away = np.linalg.norm(rows[:, :2, 1:] - expected[:, 1:], axis=-1)
        share = 1 / (1 + (away**2).mean(axis=0) / 0.7**2)
        assert share.max() < 0.9
        assert np.allclose(extra["unscattered"][:2], expected[:, 0], atol=1e-6)
        assert np.isneginf(extra["unscattered"][2])
        expected[:, 0] = (expected[:, 0] + 2.0) * share - 2.0
    assert np.allclose(fitness[:2], expected[:, 0], atol=1e-6)
    assert np.isneginf(fitness[2])
    assert np.allclose(found[:2], expected[:, 1:], atol=1e-6)
    steps = extra["transitions"]["obs"]
    assert steps.shape == (3, 2 * starts, 3)
    second = each[1][2]["transitions"]["obs"]
    own = np.stack([d[:2] for _, d, _ in each], axis=1)
    assert np.allclose(extra["episode_descriptors"][:2], own, atol=1e-6)
    # compiled, some processors round differently; other starts are far away
    assert np.allclose(steps[:, 2:4], second, atol=1e-6)
    assert not np.allclose(steps[:, :2], second, atol=1e-2)
    # the gradient is that of fitness and descriptor, by central differences
    for axis in range(2):
        moved = genotypes.at[:, axis].add(1e-2), genotypes.at[:, axis].add(-1e-2)
        (up, above, _), (down, below, _) = (score(x, KEY) for x in moved)
        slopes = np.column_stack([up - down, above - below])[:2] / 2e-2
        assert np.allclose(extra["gradients"][:2, axis], slopes, atol=2e-3)
    unit = np.linalg.norm(extra["normalized_grads"][:2], axis=1)
    assert np.allclose(unit, 1, atol=1e-5)
    assert not np.any(extra["gradients"][2])


@pytest.mark.parametrize("scatter", [None, Scatter(width=0.7, offset=2.0)])
def test_a_gradient_that_one_start_has_lost_is_lost(scatter: Scatter | None) -> None:
    """The mean of the others would be no gradient of the mean."""
    genotypes = jnp.asarray([[0.3, 0.1], [1.2, -0.7]], jnp.float32)
    first = jax.random.split(KEY, 3)[0]

    def losing(genotypes: jax.Array, key: jax.Array) -> Any:
        fitness, found, extra = some_scores(genotypes, key)
        here = jnp.all(jax.random.key_data(key) == jax.random.key_data(first))
        lost = jnp.zeros(extra["overflowed"].shape, bool).at[1, 2].set(here)
        gradients = jnp.where(lost[:, None], 0, extra["gradients"])
        given = {"gradients": gradients, "overflowed": lost}
        return fitness, found, given  # as little as emitters need

    score = jax.jit(robust_scoring(losing, starts=3, scatter=scatter))
    _, _, extra = score(genotypes, KEY)
    lost = ~np.any(extra["gradients"], axis=1)
    # with scatter, the fitness depends on every component of the descriptor
    assert lost.tolist() == [[False] * 3, [scatter is not None, False, True]]
    assert extra["overflowed"].tolist() == [[False] * 3, [False, False, True]]


def test_the_price_of_scatter() -> None:
    price = Scatter(width=3.0, offset=10.0)
    # two episodes that end 2 w apart: each is w away from their mean
    found = np.array([[[0.0, 1.0]] * 3, [[6.0, 1.0]] * 3], np.float32)
    fitnesses = np.array([30.0, -4.0, -12.0], np.float32)
    counted = jax.jit(price.counted)(fitnesses, found, found.mean(axis=0))
    # half of the fitness with offset; what is below the offset does not gain
    assert np.allclose(counted, [10.0, -7.0, -12.0])
    same = jax.jit(price.counted)(fitnesses, found[:1], found[0])
    assert np.allclose(same, fitnesses)
    # a run's width is that of a cell: 16 cells in a square of side 2
    config = SMALL.replace(scatter=0.5, starts=2)
    task = point_task(config)
    chosen = scatter_of(config, task)
    assert chosen is not None
    sides = np.asarray(task.limits[1]) - np.asarray(task.limits[0])
    assert np.isclose(chosen.width, 0.5 * np.sqrt(sides.prod() / 16))
    assert chosen.offset == task.reward_offset * config.episode_length
    # that of one of eight cells in a cube of side 4
    cube = np.zeros(3), np.full(3, 4.0)
    task = dataclasses.replace(task, limits=cube, labels=("x", "y", "z"))
    chosen = scatter_of(config.replace(grid=None, centroids=8), task)
    assert chosen is not None and np.isclose(chosen.width, 0.5 * 2.0)
    assert scatter_of(SMALL, task) is None


@pytest.mark.parametrize(
    ("numbers", "text"),
    [((0.0, 1.0), "width: got 0.0"), ((1.0, np.inf), "offset: got inf")],
)
def test_a_wrong_price(numbers: tuple[float, float], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        Scatter(*numbers)


def test_what_cannot_be_joined() -> None:
    assert robust_scoring(some_scores, starts=1) is some_scores
    with pytest.raises(ValueError, match="starts: got 0"):
        robust_scoring(some_scores, starts=0)
    with pytest.raises(
        ValueError, match="statistic: got 'mode'; allowed: mean, median"
    ):
        robust_scoring(some_scores, starts=2, statistic="mode")
    with pytest.raises(TypeError, match="score: got 3; allowed: a function of genoty"):
        robust_scoring(3, starts=2)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"scatter: got 1.0; allowed: a Scatter, None"):
        robust_scoring(some_scores, starts=2, scatter=1.0)  # type: ignore[arg-type]
    odd = robust_scoring(lambda g, k: (g[:, 0], g, {"colour": g}), starts=2)
    with pytest.raises(ValueError, match="extra scores: got 'colour'; allowed: trans"):
        odd(jnp.zeros((2, 2)), KEY)
    no_key: Any = 0
    with pytest.raises(TypeError, match="key: got 0; allowed: one key"):
        odd(jnp.zeros((2, 2)), no_key)
    found: Any
    for found, text in (
        ((jnp.zeros((2, 1)), jnp.zeros((2, 3)), {}), r"fitnesses: .*shape \(2, 1\); "),
        ((jnp.zeros(2), jnp.zeros(2), {}), r"descriptors: .* \(2,\); .* \(2, D\)"),
        ((jnp.zeros(2), jnp.zeros((2, 3))), "score: got a tuple of 2; allowed: fit"),
        (
            (jnp.zeros(2), jnp.zeros((2, 3)), {"gradients": jnp.zeros((2, 5, 3))}),
            r"scores: gradients: got shape \(2, 5, 3\); allowed: shape \(2, ..., 4\)",
        ),
        (
            (jnp.zeros(2), jnp.zeros((2, 3)), {"faulty": jnp.zeros((2, 3), bool)}),
            r"scores: faulty: got shape \(2, 3\); allowed: shape \(2,\)",
        ),
    ):
        with pytest.raises(ValueError, match=text):
            robust_scoring(lambda *_, found=found: found, starts=2)(
                jnp.zeros((2, 5)), KEY
            )
    for changes, text in (
        ({"starts": 0}, "starts: got 0"),
        ({"statistic": "mode"}, "statistic: got 'mode'; allowed: mean, median"),
        ({"scatter": -1.0}, "scatter: got -1.0"),
        ({"scatter": 1e300}, "scatter: got 1e[+]300"),
        ({"new_starts": 1}, "new_starts: got 1; allowed: True, False"),
    ):
        with pytest.raises(ConfigError, match=text):
            SMALL.replace(**changes)
    with pytest.raises(ConfigError, match=r"scatter: got 1.0; .* more than one start"):
        run(SMALL.replace(scatter=1.0))
    with pytest.raises(ConfigError, match="randomize: env: got <point_runs"):
        run(SMALL.replace(randomize={"friction": (1, 2)}))


@pytest.mark.parametrize("scatter", [0.0, 0.5])
def test_a_run_from_several_starts(tmp_path: Path, scatter: float) -> None:
    config = SMALL.replace(starts=3, scatter=scatter, iterations=2)
    result = run(config, out=tmp_path / "run")
    assert result.metrics["evaluations"].tolist() == [48, 96, 144]
    assert result.metrics["env_steps"][-1] == 144 * config.episode_length
    opened = load_run(tmp_path / "run", task_factory=point_task)
    again = opened.evaluate()
    filled = result.archive.filled
    assert np.array_equal(again.fitnesses, result.archive.fitnesses[filled])
    assert np.array_equal(again.descriptors, result.archive.descriptors[filled])
    alone = opened.evaluate(keys=jax.random.split(opened.start_key, 3))
    mean = alone.fitnesses.mean(axis=1)
    price = scatter_of(config, opened.task)
    if price is None:
        assert np.allclose(mean, again.fitnesses, rtol=1e-5)
        return
    each = np.moveaxis(np.asarray(alone.descriptors), 1, 0)
    counted = jax.jit(price.counted)(mean, each, again.descriptors)
    assert np.allclose(counted, again.fitnesses, rtol=1e-5)
    assert np.any(again.fitnesses < mean - 1)


ACTORS = {"points": 2, "probes": 3, "walks": 1, "worlds": 1, "window": 8}


@pytest.mark.parametrize(
    ("name", "options", "more"),
    [
        ("me-gradient", {}, 2),
        ("ascii-me-exact", {"branches": 4}, 4),
        ("cma-mega", {"points": 2}, 2),
        ("cma-maega-actor-critic", ACTORS, 3 * 2 + 8),
    ],
)
def test_episodes_of_an_emitter(name: str, options: Any, more: int) -> None:
    """They follow one start each, but for the evaluations of solution points."""
    config = SMALL.replace(algorithm=name, options=options, starts=3)
    assert Search(config, point_task(config))._episodes == 16 * 3 + more


def test_the_untrained_policy_has_no_price_of_scatter() -> None:
    config = SMALL.replace(starts=3, iterations=0)
    plain, priced = (run(config.replace(scatter=x)) for x in (0.0, 0.5))
    untrained = [x.metrics["initial_fitness"] for x in (plain, priced)]
    assert np.allclose(*untrained, rtol=1e-6)
    assert priced.metrics["mean_fitness"] < plain.metrics["mean_fitness"]


@pytest.mark.slow
@pytest.mark.usefixtures("sigint")
def test_new_starts_in_each_generation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = SMALL.replace(new_starts=True, iterations=4)
    whole = run(config)
    with monkeypatch.context() as patch:
        interrupt_after(patch, 2)
        run(config, out=tmp_path / "run")
    parts = run(config, out=tmp_path / "run", resume=True)
    assert np.array_equal(whole.archive.genotypes, parts.archive.genotypes)


def test_generations_and_reevaluations_have_start_states_of_their_own() -> None:
    config = SMALL.replace(new_starts=True)
    search = Search(config, point_task(config))
    keys = [search._start(i) for i in range(4)]
    assert all(key != search._key_reevaluations for key in keys)
    assert len({str(jax.random.key_data(key)) for key in keys}) == 4
    fixed = Search(SMALL, point_task(SMALL))
    assert fixed._start(0) is fixed._start(7)
    assert fixed._start(0) != fixed._key_reevaluations


@pytest.mark.parametrize("new", [False, True])
def test_emitters_evaluate_from_the_start_states_of_the_generation(new: bool) -> None:
    made: list[Any] = []
    emitter = SimpleNamespace(emit=None)  # which is not called
    algorithm: Any = SimpleNamespace(
        make=lambda context, _: made.append(context) or emitter, takes_faulty=False
    )
    config = SMALL.replace(new_starts=new)
    score: Any = lambda genotypes, key: key  # noqa: E731
    nothing: Any = None
    parts = GenerationParts(algorithm, None, config, point_task(config), nothing, score)
    first, reset, generation = jax.random.split(KEY, 3)
    parts.of(Drawn(first, reset, jnp.zeros((1, 2))))
    assert made[0].score(None, generation) == (generation if new else first)


# --- physics ---------------------------------------------------------------


@pytest.mark.slow
def test_worlds_with_random_parameters() -> None:
    env = newton_qd.create("hopper_uni", episode_length=5)
    wrapped = RandomParamsWrapper(env, friction=(0.5, 1.5), mass_scale=(0.8, 1.2))
    states = jax.jit(jax.vmap(wrapped.reset))(jax.random.split(KEY, 16))
    params = states.info["params"]
    assert np.ptp(params.friction) > 0.3 and 0.5 <= params.friction.min() <= 1.0
    assert np.ptp(params.mass_scale) > 0.2
    assert np.all(params.gravity == env.default_params.gravity)
    actions = jnp.full((16, 3), 0.5, jnp.float32)
    step = jax.jit(jax.vmap(wrapped.step))
    moved = step(states, actions)
    expected = jax.jit(jax.vmap(env.step))(states, actions, params)
    assert np.array_equal(moved.obs, expected.obs)
    for _ in range(6):  # beyond the end of the episode
        moved = step(moved, actions)
    assert np.array_equal(moved.info["params"].friction, params.friction)
    with pytest.raises(TypeError, match="colour"):
        RandomParamsWrapper(env, colour=(1, 2))
    with pytest.raises(ValueError, match="friction: got"):
        RandomParamsWrapper(env, friction=(2, 1))
    with pytest.raises(ValueError, match=r"env: got .*, and the ranges of the outer"):
        RandomParamsWrapper(wrapped, friction=(0.5, 1.5))
    pair: Any = jnp.array([0.5, 1.5])
    RandomParamsWrapper(env, friction=pair)


def test_parameters_do_not_follow_from_the_start_state() -> None:
    env = newton_qd.create("hopper_uni", auto_reset=False)
    wrapped = RandomParamsWrapper(env, friction=(0.5, 1.5))
    drawn = jax.jit(wrapped.reset)(KEY).info["params"].friction
    assert drawn != newton_qd.randomize_params(KEY, env, friction=(0.5, 1.5)).friction


def test_given_parameters_replace_those_of_the_world() -> None:
    env = newton_qd.create("hopper_uni", auto_reset=False)
    wrapped = RandomParamsWrapper(env, gravity=(9.0, 10.0))
    state, step = jax.jit(wrapped.reset)(KEY), jax.jit(wrapped.step)
    light = state.info["params"].replace(gravity=jnp.float32(1.0))
    action = jnp.zeros(3, np.float32)
    fallen, floated = step(state, action), step(state, action, light)
    assert floated.pipeline_state.v[1] > fallen.pipeline_state.v[1] + 0.01


@pytest.mark.slow
def test_a_run_in_random_worlds_repeats_bitwise(tmp_path: Path) -> None:
    config = EvolveConfig(
        env_name="hopper_uni",
        iterations=1,
        batch_size=16,
        episode_length=5,
        hidden=(4,),
        starts=2,
        reevaluations=2,
        randomize={"friction": (0.5, 1.5)},  # type: ignore[arg-type]
    )
    from newton_qd.qd import evolve

    result = evolve(config, out=tmp_path / "run", progress=False)
    again = load_run(tmp_path / "run").evaluate()
    filled = result.archive.filled
    assert np.array_equal(again.fitnesses, result.archive.fitnesses[filled])


@pytest.mark.slow
def test_map_elites_low_spread_of_qdax() -> None:
    from qdax.core.mels import MELS

    from newton_qd.qd.algorithms.variation import isoline_emitter

    task = point_task(SMALL)
    policy = make_policy(task.env, (4,))
    score = make_scoring_function(task, policy, 9)
    axis = (jnp.arange(4) + 0.5) / 4
    centroids = jnp.stack(jnp.meshgrid(axis, axis), -1).reshape(-1, 2)
    kind: Any = MELS  # its annotations are those of an earlier release
    mels = kind(
        scoring_function=score,
        emitter=isoline_emitter(SMALL, 16),
        metrics_function=lambda repertoire: {"best": repertoire.fitnesses.max()},
        num_samples=4,
    )
    genotypes = jax.vmap(policy.init)(jax.random.split(KEY, 16))
    repertoire, state, _ = mels.init(genotypes, centroids, KEY)
    for key in jax.random.split(KEY, 3):
        repertoire, state, _ = mels.update(repertoire, state, key)
    filled = np.isfinite(np.asarray(repertoire.fitnesses).reshape(-1))
    assert np.all(np.isfinite(np.asarray(repertoire.spreads).reshape(-1)[filled]))
