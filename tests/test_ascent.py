"""Elites that climb: their gradient, their steps, and where they begin."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from emitter_problems import begin, compiled, values
from point_runs import SMALL, PointEnv, point_task, run

from newton_qd.gradients import Episode, EpisodeGradients
from newton_qd.qd.algorithms.me_ascent import MEAscentOptions
from newton_qd.qd.algorithms.options import read_options
from newton_qd.qd.config import ConfigError
from newton_qd.qd.emitters import AscentEmitter
from newton_qd.qd.emitters.ascent import limited_mean, mean_slope
from newton_qd.qd.run.search import Search


def uphill(weights: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Gradient of the sphere; it is never lost."""
    del key
    slopes = jax.vmap(jax.grad(lambda x: values(x)[0]))(weights)
    return slopes, jnp.zeros(len(weights), bool)


def climbing(**changes: Any) -> AscentEmitter:
    given = {"climbers": 6, "lifetime": 3, "shortest": 0.1, "longest": 0.4}
    return AscentEmitter(**{"slope": uphill, **given, **changes})


def test_long_gradients_count_with_the_median_norm() -> None:
    rng = np.random.default_rng(0)
    gradients = rng.normal(size=(5, 3, 4)).astype(np.float32)
    gradients[0] *= 1e30  # the square of its norm overflows
    gradients[1, 0] = 0
    gradients[:, 2] = 0
    expected = np.zeros((3, 4))
    for policy in range(3):
        rows = gradients[:, policy].astype(np.float64)
        norms = np.linalg.norm(rows, axis=1)
        limit = np.median(norms)
        for row, norm in zip(rows, norms, strict=True):
            expected[policy] += row * (min(1, limit / norm) if norm else 0) / 5
    sound = np.ones((5, 3), bool)
    found = np.asarray(jax.jit(limited_mean)(gradients, sound))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(found[2], 0)


def test_only_sound_gradients_count() -> None:
    """One of three, and two of three: the longer one is shortened to the other."""
    gradients = np.array([[[3, 4]], [[0, 10]], [[0, 0]]], np.float32)
    mean = jax.jit(limited_mean)
    for sound, expected in (
        ([True, False, False], [3.0, 4.0]),
        ([True, True, False], [1.5, 4.5]),
        ([False, False, False], [0.0, 0.0]),
    ):
        found = mean(gradients, np.array(sound)[:, None])
        np.testing.assert_allclose(found, [expected], rtol=1e-6)


def policy(weights: jax.Array, obs: jax.Array) -> jax.Array:
    return weights.reshape(2, 3) @ obs


def test_the_gradient_is_that_of_the_mean_return() -> None:
    """Of two worlds, the longer gradient is shortened to the other."""
    episode = Episode(PointEnv(), policy, episode_length=4)
    weights = 0.1 * np.random.default_rng(0).normal(size=(3, 6)).astype(np.float32)
    weights[2, 2] = 2.0  # far right: a fault
    key = jax.random.key(1)
    slopes, lost = map(np.asarray, jax.jit(mean_slope(episode, 2))(weights, key))
    each = jax.jit(jax.vmap(episode.gradient, (None, 0)))
    found = np.asarray(each(weights, jax.random.split(key, 2)).gradients)[:, :, 0]
    norms = np.linalg.norm(found, axis=-1)
    shares = np.minimum(1, norms.min(0) / np.where(norms > 0, norms, 1))
    expected = (shares[..., None] * found).mean(0)
    np.testing.assert_allclose(slopes, expected, rtol=1e-5, atol=1e-6)
    assert list(lost) == [False, False, True] and not slopes[2].any()


def test_a_gradient_that_overflowed_does_not_count(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    key = jax.random.key(1)
    drawn = np.asarray(jax.vmap(jax.random.uniform)(jax.random.split(key, 2)))

    def gradient(self: Episode, weights: jax.Array, key: jax.Array) -> EpisodeGradients:
        lost = (jax.random.uniform(key) > drawn.mean())[None]
        slopes = jnp.where(lost, 0, jnp.array([3.0, 4.0]))[None, None]
        return EpisodeGradients(weights, weights, slopes, ~lost & lost, lost[:, None])

    monkeypatch.setattr(Episode, "gradient", gradient)
    episode = Episode(PointEnv(), policy, episode_length=4)
    slopes, lost = jax.jit(mean_slope(episode, 2))(np.zeros((1, 2), np.float32), key)
    np.testing.assert_allclose(slopes, [[3.0, 4.0]], rtol=1e-6)
    assert not lost.any()


def test_a_climber_makes_steps_of_one_length_with_momentum() -> None:
    def uphill(weights: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        del key  # the directions of one climber change, so its momentum counts
        turns = jnp.arange(weights.shape[1], dtype=weights.dtype)
        return jnp.sin(9 * weights + turns), jnp.zeros(len(weights), bool)

    emitter = climbing(slope=uphill, lifetime=1000, momentum=0.25)
    repertoire, state = begin(emitter)
    update, emit = compiled(emitter.state_update), compiled(emitter.emit)
    elites = np.asarray(repertoire.genotypes)[
        np.asarray(repertoire.fitnesses)[:, 0] > -np.inf
    ]
    begun, none = emit(repertoire, state, jax.random.key(0))
    assert all(np.any(np.all(x == elites, axis=1)) for x in np.asarray(begun))
    assert not none["climbers_overflowed"].any()
    state = update(state, repertoire)
    x, motion = np.asarray(state.weights), np.asarray(state.motion)
    sizes = np.asarray(state.steps)
    assert np.all((sizes >= 0.1) & (sizes <= 0.4)) and len(set(sizes)) == 6
    for _ in range(2):
        slopes = np.sin(9 * x + np.arange(x.shape[1]))
        norms = np.linalg.norm(slopes, axis=1, keepdims=True)
        motion = 0.25 * motion + 0.75 * slopes / np.where(norms > 0, norms, 1)
        norms = np.linalg.norm(motion, axis=1, keepdims=True)
        x = x + sizes[:, None] * motion / np.where(norms > 0, norms, 1)
        state = update(state, repertoire)
        emitted = emit(repertoire, state, jax.random.key(0))[0]
        np.testing.assert_allclose(emitted, x, rtol=1e-4, atol=1e-5)


def test_lengths_of_steps_are_log_uniform() -> None:
    state = begin(climbing(climbers=400, shortest=1e-3, longest=1.0))[1]
    tens = np.log10(state.steps)
    assert -3 <= tens.min() < -2.9 and -0.1 < tens.max() <= 0
    assert abs(np.median(tens) + 1.5) < 0.3


def test_a_lost_climber_begins_again() -> None:
    def lossy(weights: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        slopes, lost = uphill(weights, key)
        lost = lost.at[2].set(True)
        return jnp.where(lost[:, None], 0, slopes), lost

    emitter = climbing(slope=lossy, lifetime=1000)
    repertoire, state = begin(emitter)
    update = compiled(emitter.state_update)
    sizes = []
    for _ in range(3):
        state = update(state, repertoire)
        lost = emitter.emit(repertoire, state, jax.random.key(0))[1]
        assert list(np.flatnonzero(lost["climbers_overflowed"])) == [2]
        sizes.append(np.asarray(state.steps))
    assert list(np.flatnonzero(sizes[2] != sizes[1])) == [2]


def test_climbers_begin_again_one_after_the_other() -> None:
    emitter = climbing()
    repertoire, state = begin(emitter)
    update = compiled(emitter.state_update)
    state = update(state, repertoire)
    sizes = [np.asarray(state.steps)]
    for _ in range(6):
        state = update(state, repertoire)
        sizes.append(np.asarray(state.steps))
        fresh = sizes[-1] != sizes[-2]
        assert fresh.sum() == 2
        # a fresh climber is one step away from an elite
        away = np.asarray(state.weights)[:, None] - np.asarray(repertoire.genotypes)
        filled = np.asarray(repertoire.fitnesses)[:, 0] > -np.inf
        nearest = np.linalg.norm(away[:, filled], axis=-1).min(axis=1)
        np.testing.assert_allclose(nearest[fresh], sizes[-1][fresh], rtol=1e-4)
    ages = [(a != b) for a, b in zip(sizes[1:], sizes, strict=False)]
    assert all(sum(age[i] for age in ages) == 2 for i in range(6))


def test_climbers_rise() -> None:
    emitter = climbing(lifetime=1000, shortest=0.02, longest=0.05)
    repertoire, state = begin(emitter)
    update = compiled(emitter.state_update)
    state = update(state, repertoire)  # the first climber begins again
    heights = compiled(lambda weights: jax.vmap(values)(weights)[:, 0])
    before = np.asarray(heights(state.weights))
    for _ in range(8):
        state = update(state, repertoire)
    assert np.all(np.asarray(heights(state.weights)) > before)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"climbers": 0}, "climbers: got 0; allowed: .* from 1"),
        ({"lifetime": 0}, "lifetime: got 0; allowed: .* from 1"),
        ({"lifetime": 2**40}, "lifetime: got 1099511627776; allowed: .* 1073741824"),
        ({"shortest": 0.0}, r"shortest: got 0.0; allowed: .* above 0"),
        ({"shortest": 0.5}, r"longest: got 0.4; allowed: .* from 0.5"),
        ({"longest": float("inf")}, r"longest: got inf; allowed: finite"),
        ({"momentum": 1.0}, "momentum: got 1.0; allowed: .* below 1"),
    ],
)
def test_wrong_climbers_are_refused(given: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        climbing(**given)


def test_wrong_types_are_refused() -> None:
    with pytest.raises(TypeError, match="slope: got 3; allowed: a function"):
        climbing(slope=3)
    with pytest.raises(TypeError, match="longest: got 'a'; allowed"):
        climbing(longest="a")
    with pytest.raises(TypeError, match="episode: got None; allowed: an Episode"):
        mean_slope(None, 2)  # pyright: ignore[reportArgumentType]


def test_an_episode_needs_start_states() -> None:
    episode = Episode(PointEnv(), policy, episode_length=4)
    with pytest.raises(ValueError, match=r"worlds: got 0; allowed: .* from 1"):
        mean_slope(episode, 0)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"climbers": 0}, "options: climbers: got 0; allowed: .* from 1"),
        ({"climb_steps": 0}, "options: climb_steps: got 0; allowed: .* from 1"),
        ({"climb_worlds": 0}, "options: climb_worlds: got 0; allowed: .* from 1"),
        ({"climb_steps": 2**40}, "options: climb_steps: got 1099511627776; allowed"),
        ({"climb_shortest": 0.2}, r"options: climb_longest: got 0.05; .* from 0.2"),
        ({"climb_termination_width": 1e-9}, "options: climb_termination_width: got"),
        ({"climb_momentum": 1.0}, "options: climb_momentum: got 1.0; .* below 1"),
    ],
)
def test_wrong_options_are_refused(options: dict[str, Any], text: str) -> None:
    config = SMALL.replace(algorithm="me-ascent", options=options)
    with pytest.raises(ConfigError, match=text):
        read_options(MEAscentOptions, config)


ACTORS = {
    **{"actors": 1, "branches": 1, "copies": 4, "updates": 1},
    **{"worlds": 2, "window": 4, "batches": 2, "critic": (8,)},
}


def test_climbers_are_a_part_of_a_generation() -> None:
    """Beside those of the actors; the rest are iso+line variations."""
    options: Any = {**ACTORS, "climbers": 5, "climb_worlds": 2}
    config = SMALL.replace(algorithm="me-actor-critic", options=options)
    generation: Any = Search(config, point_task(config))._generation
    parts = generation.emitter.emitters
    assert [part.batch_size for part in parts] == [4, 5, 7]
    config = config.replace(options={**options, "climbers": 13})
    with pytest.raises(
        ConfigError, match=r"climbers: got 13; .* most 12 with .* actors have 4"
    ):
        Search(config, point_task(config)).empty()


def test_a_run_counts_what_is_differentiated() -> None:
    config = SMALL.replace(algorithm="me-ascent", iterations=3)
    options: Any = {"climbers": 16, "climb_worlds": 3}
    metrics = run(dataclasses.replace(config, options=options)).metrics
    np.testing.assert_array_equal(np.diff(metrics["evaluations"]), 16 + 16 * 3)
    assert metrics["qd_score"][-1] > metrics["qd_score"][0]


@pytest.mark.slow
def test_only_what_is_scored_has_several_starts() -> None:
    """Each evaluation counts once for each start, each gradient once."""
    config = SMALL.replace(algorithm="me-ascent", iterations=1, starts=3)
    options: Any = {"climbers": 16, "climb_worlds": 3}
    metrics = run(dataclasses.replace(config, options=options)).metrics
    np.testing.assert_array_equal(np.diff(metrics["evaluations"]), 16 * 3 + 16 * 3)
