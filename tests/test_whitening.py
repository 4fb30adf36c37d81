"""Weights of a policy in terms of whitened observations."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from point_runs import PointEnv

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
