"""Actors that learn from whole episodes, on a point and on a hopper that falls."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_runs import SMALL, PointEnv, point_task
from qdax.core.containers.mapelites_repertoire import (
    MapElitesRepertoire,
    compute_euclidean_centroids,
)
from test_actor_critic import (
    LENGTH,
    SETTINGS,
    SIZE,
    compiled,
    learner,
    method,
    play,
    policy,
    reading,
    weights_of,
)

from newton_qd.qd import EvolveConfig, make_task
from newton_qd.qd.algorithms.gradient_options import (
    DifferentiableOptions,
    differentiable,
)
from newton_qd.qd.algorithms.me_actor_critic import ME_ACTOR_CRITIC
from newton_qd.qd.config import ConfigError
from newton_qd.qd.emitters import ActorCriticEmitter
from newton_qd.qd.emitters.actor_critic_learner import ActorCritic
from newton_qd.qd.emitters.episode_learner import EpisodeLearning
from newton_qd.qd.emitters.whitening import Whitening
from newton_qd.qd.run.search import Search
from newton_qd.qd.scoring.networks import policy_for
from newton_qd.qd.scoring.rollout import episode_of

KEY = jax.random.key(4)
# scale of observations
PLAIN: Any = (np.zeros(3, np.float32), np.ones(3, np.float32))


def episodes(
    measure: Any = reading, *, noise: float = 0.0, **changes: Any
) -> EpisodeLearning:
    given: dict[str, Any] = {"after": 2, "updates": 1, "weight_noise": 0.0, **changes}
    return EpisodeLearning(method(measure, noise=noise), PointEnv(), **given)


@functools.cache
def slopes(averaged: bool) -> Any:
    return compiled(episodes(averaged=averaged).slopes)


@compiled
def slopes_by_hand(weights: jax.Array, start: Any, averaged: jax.Array) -> Any:
    """Of rewards and measures up to a fall, added up step by step."""
    env = PointEnv()

    def total(weights: jax.Array, state: Any) -> tuple[jax.Array, jax.Array]:
        def advance(carry: Any, _: None) -> tuple[Any, None]:
            state, sums, up = carry
            state = env.step(state, policy(weights, state.obs))
            gains = jnp.array([state.reward, *state.pipeline_state, 1.0])
            return (state, sums + up * gains, up * (1 - state.done)), None

        carry = state, jnp.zeros(4), jnp.ones(())
        (_, sums, up), _ = jax.lax.scan(advance, carry, length=LENGTH)
        share = jnp.where(averaged, LENGTH / sums[3], 1)
        return jnp.append(sums[0], sums[1:3] * share) @ start.aim, up

    each = jax.vmap(jax.grad(total, has_aux=True), in_axes=(None, 0))
    return each(weights, start.first)


@pytest.mark.parametrize("averaged", [False, True])
@pytest.mark.parametrize("size", [0.3, 3.0])  # the second one falls
def test_the_gradient_is_that_of_the_episode(size: float, averaged: bool) -> None:
    start, weights = learner((1.0, 0.3, -0.2)), weights_of(size)
    found, sound = slopes(averaged)(weights, start, jax.random.key(6))
    expected, up = jax.device_get(slopes_by_hand(weights, start, averaged))
    assert (up.min() == 0) == (size == 3.0) and np.all(sound)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


def test_each_world_has_weights_of_its_own() -> None:
    later = episodes(weight_noise=0.3)
    start, key = jax.device_get(learner()), jax.random.key(6)
    weights = np.array([0.5, 0.4, 0.6, -0.3, 0.1, 0.2], np.float32)
    found, sound = jax.device_get(compiled(later.slopes)(weights, start, key))
    assert sound.any() and not sound.all()  # a fault does not count
    rest = np.zeros((LENGTH, 2), np.float32)
    other = jax.random.normal(jax.random.split(key)[1], (SETTINGS.worlds, SIZE))
    alone = compiled(jax.grad(later._worth, has_aux=True))
    for world, own in enumerate(weights + np.float32(0.3) * np.asarray(other)):
        first = jax.tree.map(lambda x, world=world: x[world], start.first)
        slope, faulty = alone(own, start.aim, first, rest)
        assert bool(faulty) is not bool(sound[world])
        slope = np.where(faulty, 0, slope)
        np.testing.assert_allclose(found[world], slope, rtol=1e-5, atol=1e-5)


def test_weights_for_whitened_observations_have_their_own_gradient() -> None:
    white = Whitening(np.arange(6).reshape(3, 2), np.array([6, 7]))

    def biased(weights: jax.Array, obs: jax.Array) -> jax.Array:
        return policy(weights[:6], obs) + weights[6:]

    way = dataclasses.replace(
        method(noise=0.0, worlds=1), policy=biased, whitening=white
    )
    later = EpisodeLearning(way, PointEnv(), after=0, updates=1, weight_noise=0.0)

    @compiled
    def both() -> tuple[jax.Array, jax.Array]:
        scale = jnp.array([0.5, -1.0, 0.2]), jnp.array([0.5, 2.0, 1.0])
        weights, aim = 0.1 * jax.random.normal(KEY, (8,)), jnp.array([1.0, 0.3, -0.2])
        first = jax.vmap(PointEnv().reset)(KEY[None])

        def worth(weights: jax.Array) -> jax.Array:
            one = jax.tree.map(lambda x: x[0], first)
            rest = jnp.zeros((LENGTH, 2))
            return later._worth(white.plain(weights, scale), aim, one, rest)[0]

        start = way.begin(KEY, weights, aim, first)
        moments = later.update(start, scale, KEY)[0].moments[0]
        mean = next(x for x in jax.tree.leaves(moments) if x.shape == (8,))
        return mean, jax.grad(worth)(weights)

    # Adam's mean of the loss, whose length is limited
    mean, slope = jax.device_get(both())
    found, expected = (x / np.linalg.norm(x) for x in (-mean, slope))
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.slow
def test_a_fall_has_the_gradient_of_an_episode() -> None:
    """Against the gradient of the return that other algorithms use."""
    config = EvolveConfig(env_name="hopper_uni", episode_length=40, hidden=(4,))
    task = differentiable(make_task(config), DifferentiableOptions(), 0.03)
    policy = policy_for(task, config.hidden)
    settings = dataclasses.replace(SETTINGS, worlds=2, noise=0.0)
    way = ActorCritic(
        task.env, policy.of_weights, lambda *_: jnp.zeros(1), 40, settings
    )
    later = EpisodeLearning(way, task.env, after=1, updates=1, weight_noise=0.0)
    keys = jax.random.split(jax.random.key(0), 2)
    first = jax.jit(jax.vmap(task.env.reset))(keys)
    weights = policy.init(jax.random.key(1))
    start = way.begin(jax.random.key(2), weights, jnp.array([1.0, 0.0]), first)
    found, sound = jax.jit(later.slopes)(weights, start, jax.random.key(3))
    alone = dataclasses.replace(task, descriptor_extractor=None)
    episode = episode_of(alone, policy, 40)
    result = jax.jit(jax.vmap(episode.gradient, (None, 0)))(weights[None], keys)
    expected = np.asarray(result.gradients)[:, 0, 0]
    norms = np.linalg.norm(expected, axis=1)
    assert (norms > 1).all() and np.asarray(sound).all()
    errors = np.linalg.norm(np.asarray(found) - expected, axis=1)
    np.testing.assert_array_less(errors, 1e-3 * norms)


@pytest.mark.slow
def test_actors_reach_what_they_aim_at() -> None:
    later = episodes(noise=0.1, weight_noise=0.1)
    start = learner()

    def update(carry: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        return later.update(carry, PLAIN, key)

    keys = jax.random.split(jax.random.key(3), 60)
    best, lost = compiled(lambda: jax.lax.scan(update, start, keys))()
    assert not np.asarray(lost).any()
    assert play(jnp.zeros(SIZE))[0] < 12 < 17 < play(best.weights)[0]


def broken(after_this: Any, before: Any, after: Any) -> jax.Array:
    del before
    position = after.pipeline_state
    return jnp.where(position > after_this, jnp.nan, position)


@compiled
def updated(start: Any, limit: jax.Array) -> tuple[Any, jax.Array]:
    """An actor after an update with a measure that is no number beyond a limit."""
    later = episodes(functools.partial(broken, limit))
    return later.update(start, PLAIN, jax.random.key(2))


@pytest.mark.parametrize(("limit", "lost"), [(-9.0, True), (9.0, False)])
def test_lost_gradients_change_nothing(limit: float, lost: bool) -> None:
    start = learner((1.0, 1.0, 1.0))
    after, failed = updated(start, np.float32(limit))
    assert bool(failed) is lost
    same = np.array_equal(after.weights, start.weights)
    assert same is lost and np.isfinite(after.weights).all()
    for name in ("critic", "target", "worlds", "age", *(["moments"] if lost else [])):
        kept = zip(
            jax.tree.leaves(getattr(after, name)),
            jax.tree.leaves(getattr(start, name)),
            strict=True,
        )
        for found, expected in kept:
            np.testing.assert_array_equal(found, expected)


def test_actors_go_on_from_episodes_after_some_generations() -> None:
    """Up to then nothing changes; then only the weights do, with a new optimizer."""
    cells = compute_euclidean_centroids((4, 4), [-2.0, -2.0], [2.0, 2.0])
    genotypes = 0.1 * jax.random.normal(jax.random.key(0), (4, SIZE), jnp.float32)
    given = genotypes, jnp.arange(4.0), genotypes[:, :2]
    archive = compiled(MapElitesRepertoire.init)(*given, cells, {})
    counts: Any = {"actors": 2, "branches": 1, "updates": 2, "steered": 0.0}
    first = compiled(PointEnv().reset)(jax.random.key(0))

    def states(later: EpisodeLearning | None) -> list[Any]:
        made = ActorCriticEmitter(method(), first, **counts, measures=2, later=later)
        update = compiled(made.state_update)
        rows = [compiled(made.init)(jax.random.key(1), archive, *given, {})]
        for _ in range(4):
            rows.append(update(rows[-1], archive))
        return rows

    windows, both = states(None), states(episodes(noise=0.1, updates=3))
    for number, (one, two) in enumerate(zip(windows, both, strict=True)):
        equal = np.array_equal(one.learners.weights, two.learners.weights)
        assert equal == (number <= 2)
    for state, updates in zip(both[2:], (4, 3, 6), strict=True):
        counts = [x for x in jax.tree.leaves(state.learners.moments[0]) if x.ndim == 1]
        np.testing.assert_array_equal(counts[0], updates)
        np.testing.assert_array_equal(state.learners.age, both[2].learners.age)
        assert not np.asarray(state.failed).any()
    moved = np.asarray(both[4].learners.weights - both[3].learners.weights)
    assert (np.linalg.norm(moved, axis=1) > 0).all()


ACTORS: dict[str, Any] = {
    **{"actors": 2, "branches": 1, "copies": 2, "updates": 1},
    **{"worlds": 2, "window": 4, "batches": 2, "critic": (8,)},
}


def test_a_run_counts_the_longer_of_both() -> None:
    config = SMALL.replace(algorithm="me-actor-critic")
    windows = ME_ACTOR_CRITIC.read_options(config.replace(options=ACTORS))
    both = {**ACTORS, "episodes_after": 3, "episode_updates": 2}
    both = ME_ACTOR_CRITIC.read_options(config.replace(options=both))
    steps = 2 * 2 * 4
    assert windows.episodes(config) == -(-steps // config.episode_length)
    assert both.episodes(config) == 2 * 2 * 2


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"after": -1}, "after: got -1; allowed: .* from 0"),
        ({"after": 2**31}, "after: got 2147483648; allowed: .* from 0 to 2147483647"),
        ({"updates": 0}, "updates: got 0; allowed: .* from 1"),
        ({"weight_noise": -0.1}, "weight_noise: got -0.1; allowed: .* from 0"),
    ],
)
def test_bad_numbers_are_refused(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        episodes(**changes)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"episodes_after": -1}, "options: episodes_after: got -1; allowed: .* from 0"),
        ({"episodes_after": 2**40}, "options: episodes_after: got 1099511627776"),
        ({"episode_updates": 0}, "options: episode_updates: got 0; .* from 1"),
        ({"episode_termination_width": 1e-9}, "episode_termination_width: got 1e-09"),
        ({"climb_momentum": 1.0}, "options: climb_momentum: got 1.0; .* below 1"),
    ],
)
def test_wrong_options_are_refused(options: dict[str, Any], text: str) -> None:
    config = SMALL.replace(algorithm="me-actor-critic", options={**ACTORS, **options})
    with pytest.raises(ConfigError, match=text):
        Search(config, point_task(config)).empty()
