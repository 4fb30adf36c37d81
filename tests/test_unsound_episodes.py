"""Episodes with numbers that are not finite teach no emitter anything."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_runs import SMALL, PointEnv, PointState, point_task

import newton_qd.compat
from newton_qd.qd.algorithms.me_es import _neutral
from newton_qd.qd.run.search import Search

# QDax and what it imports warn about their own use of other packages.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

CRITIC = {
    "critic_hidden_layer_size": (8,),
    "num_critic_training_steps": 4,
    "num_pg_training_steps": 2,
    "batch_size": 32,
    "replay_buffer_size": 1024,
}


class Broken(PointEnv):
    """A point whose reward is NaN on the right."""

    state_descriptor_length = 2

    def step(self, state: PointState, action: jax.Array) -> PointState:
        found = super().step(state, action)
        right = found.pipeline_state[0] > 0.4
        return dataclasses.replace(
            found, reward=jnp.where(right, jnp.nan, found.reward)
        )


def critic_of(name: str, env: Any, starts: int = 1) -> tuple[Any, np.ndarray]:
    """State of an emitter after some generations, and their rejected individuals."""
    config = SMALL.replace(algorithm=name, options=CRITIC, starts=starts)
    newton_qd.compat.install()
    try:
        search = Search(config, point_task(config, env))
        state = search.empty()
        for _ in range(4):
            state = search.advance(state)
    finally:
        newton_qd.compat.uninstall()
    return state.emitter, state.metrics[:, 3]


@pytest.mark.parametrize(("name", "starts"), [("pga-me", 1), ("dcrl-me", 2)])
def test_a_nan_does_not_stay_in_a_critic(name: str, starts: int) -> None:
    state, rejected = critic_of(name, Broken(), starts)
    assert rejected[0] > 0
    assert rejected[-1] < SMALL.batch_size / 2
    state = jax.tree.map(
        lambda x: (
            jax.random.key_data(x)
            if jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
            else x
        ),
        state,
    )
    weights = [x for x in jax.tree.leaves(state) if x.dtype == jnp.float32]
    buffers = [x for x in weights if x.shape[0:1] == (1024,)]
    assert len(buffers) == 1  # the rest of it is empty
    filled = SMALL.batch_size * SMALL.episode_length * starts * 4
    assert np.isfinite(buffers[0][: min(filled, 1024)]).all()
    for leaf in weights:
        if leaf.shape[0:1] != (1024,):
            assert np.isfinite(leaf).all()


class Unlimited(PointEnv):
    """An environment whose descriptor has no limits, so the task sets them."""

    state_descriptor_length = 2
    descriptor_length = 2
    descriptor_limits = (jnp.full(2, -jnp.inf), jnp.full(2, jnp.inf))


@pytest.mark.parametrize("env", [PointEnv, Unlimited])
def test_limits_of_a_task_are_those_of_dcrl_me(env: type) -> None:
    state, rejected = critic_of("dcrl-me", env())
    assert rejected.max() < SMALL.batch_size / 4
    weights = [x for x in jax.tree.leaves(state) if jnp.ndim(x) == 2]
    assert all(
        np.isfinite(x).all() for x in weights if x.shape[0] != 1024 and len(x) < 1000
    )


def test_failed_samples_of_me_es_lead_nowhere() -> None:
    fitnesses = jnp.asarray([1.0, -jnp.inf, 3.0, 5.0])
    found = jnp.asarray([[0.0, 2.0], [7.0, 7.0], [1.0, jnp.nan], [4.0, 4.0]])

    def score(genotypes: Any, key: Any) -> Any:
        del genotypes, key
        return fitnesses, found, {}

    ranked = _neutral(score, finite=False)(None, None)  # pyright: ignore[reportArgumentType]
    assert ranked[0].tolist() == [1, -np.inf, 3, 5]
    assert ranked[1].tolist() == [[0, 2], [2, 3], [2, 3], [4, 4]]
    plain = _neutral(score, finite=True)(None, None)  # pyright: ignore[reportArgumentType]
    assert plain[0].tolist() == [1, 1, 1, 5]
