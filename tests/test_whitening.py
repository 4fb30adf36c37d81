"""Weights of a policy in terms of whitened observations."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from point_runs import PointEnv
from qdax.core.containers.mapelites_repertoire import (
    MapElitesRepertoire,
    compute_euclidean_centroids,
)

from newton_qd.qd.emitters import ActorCritic, ActorCriticEmitter, ActorCriticSettings
from newton_qd.qd.emitters.whitening import Whitening
from newton_qd.qd.scoring.networks import policy_of
from newton_qd.qd.scoring.rollout import make_policy


def test_plain_weights_do_what_the_whitened_ones_do() -> None:
    """A policy of plain observations equals one of whitened observations."""
    policy = make_policy(PointEnv(), (5, 4))
    white = Whitening.of(policy)
    draws = np.random.default_rng(0).normal(size=(3, PointEnv().observation_size))
    draws = draws.astype(np.float32)
    mean, deviation = 3 * draws[0], np.exp(2 * draws[1])
    # an environment may tell the critic more than the policy sees
    scale = np.append(mean, np.float32(7)), np.append(deviation, np.float32(9))
    draw = jax.jit(lambda key: jax.vmap(policy.init)(jax.random.split(key, 3)))
    weights = jax.device_get(draw(jax.random.key(0)))
    obs = mean + deviation * draws[2]

    to_plain, to_white = jax.jit(white.plain), jax.jit(white.whitened)
    plain = jax.device_get(to_plain(weights, scale))
    act = jax.jit(jax.vmap(policy.of_weights, (0, None)))
    expected = act(weights, (obs - mean) / deviation)
    np.testing.assert_allclose(act(plain, obs), expected, atol=1e-5)
    np.testing.assert_allclose(to_white(plain, scale), weights, atol=1e-5)
    assert np.abs(plain - weights).max() > 0.1
    # it is linear, so it converts steps too
    step = to_plain(weights[1], scale)
    np.testing.assert_allclose(
        to_plain(weights[0] + weights[1], scale),
        plain[0] + step,
        rtol=1e-5,
        atol=1e-5,
    )


def test_a_network_without_a_known_first_layer_stays_as_it_is() -> None:
    """Its weights have no places that could be converted."""

    class Model:
        def init(self, key: jax.Array, obs: jax.Array) -> dict[str, jax.Array]:
            return {"matrix": jax.random.normal(key, (obs.size, 2))}

        def apply(self, tree: dict[str, jax.Array], obs: jax.Array) -> jax.Array:
            return jnp.tanh(obs @ tree["matrix"])

    policy = policy_of(PointEnv(), Model())
    white = Whitening.of(policy)
    weights = policy.init(jax.random.key(0))
    scale = jnp.zeros(9), 2 * jnp.ones(9)
    assert white.plain(weights, scale) is weights
    assert white.whitened(weights, scale) is weights


def test_elites_are_whitened_before_actors_learn_from_them() -> None:
    """The conversion is linear, so what lies between whitened weights does so plain."""
    white = Whitening(np.arange(6).reshape(3, 2), np.array([6, 7]))
    scale = jnp.array([1.0, -2.0, 3.0]), jnp.array([0.5, 2.0, 4.0])
    nothing: Any = None
    settings, sums = ActorCriticSettings(), lambda *_: jnp.zeros(2)
    made: Any = ActorCriticEmitter(
        ActorCritic(PointEnv(), sums, sums, 5, settings, white),
        nothing,
        actors=2,
        branches=1,
        copies=2,
        updates=1,
        spread=(1e-9, 1e-9),
        steered=1.0,
        lifetime=1,
        measures=2,
    )
    made._begun = lambda key, weights, aims: weights
    cells = compute_euclidean_centroids((2, 2), [0.0, 0.0], [1.0, 1.0])
    elite = jax.random.normal(jax.random.key(0), (8,))
    held: Any = MapElitesRepertoire.init_default(elite, cells)
    held = held.replace(
        genotypes=jnp.tile(elite, (4, 1)), fitnesses=jnp.zeros_like(held.fitnesses)
    )
    actors = jax.random.normal(jax.random.key(1), (2, 8))
    state = SimpleNamespace(
        learners=actors,
        scale=scale,
        snapshots=actors[None],
        failed=None,
        generation=jnp.ones((), jnp.int32),
    )

    def run(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        renewed = made._renewed(state, held, key)
        return made.emit(held, state, key)[0], white.plain(renewed, scale)

    found, renewed = jax.device_get(jax.jit(run)(jax.random.key(2)))
    np.testing.assert_allclose(renewed, held.genotypes[:2], rtol=1e-5, atol=1e-5)
    own, between = found[:2], found[2:]
    parts = (between - own)[:, 0] / (elite - own)[:, 0]
    assert ((parts > 0) & (parts < 1)).all()
    expected = own + parts[:, None] * (elite - own)
    np.testing.assert_allclose(between, expected, rtol=1e-4, atol=1e-5)
