"""One critic that all actors learn together, on a point that is pushed about."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from point_runs import PointEnv
from qdax.core.containers.mapelites_repertoire import (
    MapElitesRepertoire,
    compute_euclidean_centroids,
)

from newton_qd.qd.algorithms.me_actor_critic import ActorCriticOptions
from newton_qd.qd.emitters import ActorCriticEmitter, ActorCriticSettings
from newton_qd.qd.emitters.actor_critic_learner import ACTORS, ActorCritic

# These programs run for milliseconds: they need no optimizer.
compiled = functools.partial(
    jax.jit, compiler_options={"xla_backend_optimization_level": 0}
)
SIZE, LENGTH, ACTORS_COUNT = 6, 20, 3
SETTINGS = ActorCriticSettings(
    worlds=4, window=5, clip=1e6, noise=0.0, critic=(8,), batches=1, epochs=1
)
LIMITS = (np.full(2, -2.0, np.float32), np.full(2, 2.0, np.float32))
SCALE = (jnp.array([0.1, -0.2, 0.0]), jnp.array([0.5, 0.7, 1.0]))


def policy(weights: jax.Array, obs: jax.Array) -> jax.Array:
    return jnp.tanh(obs @ weights.reshape(3, 2))


def reading(before: Any, after: Any) -> jax.Array:
    del before
    return after.pipeline_state


WAY = ActorCritic(PointEnv(), policy, reading, LENGTH, SETTINGS, shared=True)


def actors() -> Any:
    """Actors with one critic, and different weights, aims and descriptors."""
    keys = jax.random.split(jax.random.key(0), 4)
    first = jax.vmap(PointEnv().reset)(jax.random.split(keys[0], SETTINGS.worlds))
    weights = 0.3 * jax.random.normal(keys[1], (ACTORS_COUNT, SIZE))
    aims = jax.random.normal(keys[2], (ACTORS_COUNT, 3))
    told = jnp.concatenate([aims[:, 1:] / 2, aims], axis=1)
    begin = jax.vmap(WAY.begin, (None, 0, 0, None, 0))
    return begin(keys[3], weights, aims, first, told)


@pytest.mark.parametrize("lost", [None, 1])
def test_the_critic_learns_from_all_finite_windows(lost: int | None) -> None:
    """One step of the critic, from the mean of the error over these windows."""
    start = actors()
    if lost is not None:
        start = dataclasses.replace(start, weights=start.weights.at[lost].set(jnp.nan))
    sound = [number for number in range(ACTORS_COUNT) if number != lost]
    silent = jnp.zeros((SETTINGS.window, 2))

    def windows(learner: Any) -> tuple[jax.Array, jax.Array]:
        run = functools.partial(WAY._window, learner.weights, learner, SCALE)
        found = jax.vmap(lambda a, b: run(a, b, silent)[1])
        _, obs, targets, _ = found(learner.first, learner.worlds)
        return obs, targets

    obs, targets = compiled(jax.vmap(windows))(start)
    critic = jax.tree.map(lambda leaf: leaf[0], start.critic)

    def error(critic: Any) -> jax.Array:
        errors = []
        for number in sound:
            value = functools.partial(
                WAY._value, critic, SCALE, told=start.told[number]
            )
            values = jax.vmap(jax.vmap(value))(obs[number])
            gaps = (1 - SETTINGS.discount) * (values - targets[number])
            errors.append(jnp.square(gaps))
        return jnp.stack(errors).mean()

    optimizer = WAY._optimizers[1]
    slopes = compiled(jax.grad(error))(critic)
    change, moments = optimizer.update(slopes, optimizer.init(critic))
    expected = jax.tree.leaves((optax.apply_updates(critic, change), moments))

    update = jax.vmap(WAY.update, (0, None, 0), axis_name=ACTORS)
    keys = jax.random.split(jax.random.key(1), ACTORS_COUNT)
    after, failed = compiled(update)(start, SCALE, keys)
    assert failed.tolist() == [number == lost for number in range(ACTORS_COUNT)]
    leaves = jax.tree.leaves((after.critic, after.moments[1]))
    for found, wanted in zip(leaves, expected, strict=True):
        np.testing.assert_array_equal(found, np.broadcast_to(found[0], found.shape))
        np.testing.assert_allclose(found[0], wanted, rtol=1e-3, atol=1e-6)
    moved = np.any(np.asarray(after.weights != start.weights), axis=1)
    assert moved[sound].all()


def test_an_actor_tells_the_critic_where_it_began_and_what_it_aims_at() -> None:
    given = {"actors": 3, "branches": 1, "copies": 2, "updates": 1, "lifetime": 2}
    options: Any = {**given, "steered": 0.7, "limits": LIMITS}
    first = PointEnv().reset(jax.random.key(0))
    made = ActorCriticEmitter(WAY, first, **options)
    cells = compute_euclidean_centroids((4, 4), [-2.0, -2.0], [2.0, 2.0])
    genotypes = 0.1 * jax.random.normal(jax.random.key(0), (16, SIZE), jnp.float32)
    places = jnp.stack([cells[:, 0], -cells[:, 1]], axis=1)
    fitnesses = jnp.arange(16.0)
    repertoire = MapElitesRepertoire.init(genotypes, fitnesses, places, cells, {})
    state = compiled(made.init)(
        jax.random.key(1), repertoire, genotypes, fitnesses, places, {}
    )
    # the best begin
    np.testing.assert_array_equal(state.learners.told[:, :2], places[:-4:-1] / 2)
    update, before = compiled(made.state_update), state
    for _ in range(4):
        after = update(before, repertoire)
        told = np.asarray(after.learners.told)
        np.testing.assert_array_equal(told[:, 2:], after.learners.aim)
        for row in told[:, :2]:
            assert (row == places / 2).all(axis=1).any()
        for leaf in jax.tree.leaves((after.learners.critic, after.learners.target)):
            np.testing.assert_array_equal(leaf, np.broadcast_to(leaf[0], leaf.shape))
        before = after
    # actors have begun again, and the critic went on to learn
    changed = np.any(before.learners.told != state.learners.told, axis=1)
    assert changed.tolist() == [False, True, True]
    steps = before.learners.moments[1][1][0].count
    np.testing.assert_array_equal(steps, 4)


def test_sharing_of_a_wrong_type_is_refused() -> None:
    with pytest.raises(TypeError, match="shared: got 'yes'; allowed: True, False"):
        ActorCriticOptions(shared="yes")  # pyright: ignore[reportArgumentType]
