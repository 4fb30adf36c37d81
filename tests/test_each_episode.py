"""Emitters that learn from transitions are told the descriptor of each episode."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_runs import SMALL, PointEnv, PointState, point_task

import newton_qd.compat
from newton_qd.qd.algorithms.each_episode import EachEpisode
from newton_qd.qd.run.search import Search

# QDax and what it imports warn about their own use of other packages.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

STARTS, LENGTH = 3, SMALL.episode_length


class Told:
    """An emitter that keeps what it is told."""

    def init(self, key: jax.Array, **told: Any) -> Any:
        return told

    def state_update(self, _: Any, **told: Any) -> Any:
        return told


def test_an_episode_stands_in_for_an_individual() -> None:
    learner: Any = Told()
    emitter = EachEpisode(learner, learner, 2)
    steps = {"obs": jnp.arange(2 * 6).reshape(2, 6, 1)}  # two starts, three steps each
    descriptors = jnp.arange(8.0).reshape(2, 2, 2)
    told = {
        "genotypes": jnp.asarray([[1.0], [2.0]]),
        "fitnesses": jnp.asarray([1.0, 2.0]),
        "descriptors": descriptors.mean(axis=1),
        "extra_scores": {"transitions": steps, "episode_descriptors": descriptors},
    }
    first = emitter.init(jax.random.key(0), **told)
    assert first["descriptors"].tolist() == descriptors.reshape(4, 2).tolist()
    assert first["fitnesses"].tolist() == first["genotypes"][:, 0].tolist()
    assert first["fitnesses"].tolist() == [1, 1, 2, 2]
    steps = first["extra_scores"]["transitions"]["obs"][..., 0]
    assert steps.tolist() == np.arange(12).reshape(4, 3).tolist()
    told["extra_scores"] |= {"desc_prime": jnp.asarray([[5.0, 6.0]])}
    later = emitter.state_update(first, **told)
    assert later["extra_scores"]["desc_prime"].tolist() == [[5, 6], [5, 6]]


class Point(PointEnv):
    """A point for QDax's emitters; some episodes of an individual end elsewhere."""

    descriptor_length = 2
    descriptor_limits = (jnp.zeros(2), jnp.ones(2))

    def _state(self, position: jax.Array, reward: jax.Array) -> PointState:
        state = super()._state(position, reward)
        state.info["truncation"] = jnp.zeros((), jnp.float32)
        return state


@pytest.mark.slow
def test_dcrl_me_learns_from_the_descriptor_of_each_episode() -> None:
    newton_qd.compat.install()
    from qdax.core.neuroevolution.buffers.buffer import DCRLTransition

    options = {
        "critic_hidden_layer_size": (8,),
        **{"num_critic_training_steps": 2, "num_pg_training_steps": 2},
        **{"batch_size": 16, "replay_buffer_size": 1024},
    }
    config = SMALL.replace(
        algorithm="dcrl-me", options=options, starts=STARTS, statistic="median"
    )
    try:
        search = Search(config, point_task(config, Point()))
        state = search.advance(search.advance(search.empty()))
    finally:
        newton_qd.compat.uninstall()
    buffer = state.emitter.emitter_states[0].replay_buffer
    steps = DCRLTransition.from_flatten(buffer.data, buffer.transition)
    used = 2 * config.batch_size * STARTS
    episodes = jax.tree.map(
        lambda leaf: np.asarray(leaf[: used * LENGTH]).reshape(used, LENGTH, -1), steps
    )
    whole = ~episodes.dones[..., 0].any(axis=1)
    reached = 2 * (episodes.obs[..., :2] > 0.2).mean(axis=1) - 1
    assert whole.mean() > 0.5
    for step in range(LENGTH):
        np.testing.assert_allclose(
            episodes.desc[whole, step], reached[whole], atol=1e-6
        )
    each = episodes.desc[:, 0].reshape(2, config.batch_size, STARTS, 2)
    assert (np.ptp(each, axis=2) > 0).any()
    # critic and actor make eight of the second generation, for one descriptor each
    wanted = episodes.desc_prime[:, 0].reshape(each.shape)
    assert not np.ptp(wanted[1, :8], axis=1).any()
    np.testing.assert_array_equal(wanted[1, 8:], each[1, 8:])
    np.testing.assert_array_equal(wanted[0], each[0])
