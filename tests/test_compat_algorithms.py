"""Algorithms of QDax on the environments of this library, after one line."""

from __future__ import annotations

import functools
import importlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compat_helpers import Setup, setup

import newton_qd

pytestmark = pytest.mark.usefixtures("modules_of_qdax")


def variation(iso: float = 0.05) -> Any:
    operators: Any = importlib.import_module("qdax.core.emitters.mutation_operators")
    return functools.partial(operators.isoline_variation, iso_sigma=iso, line_sigma=0.1)


def mixing(task: Setup, batch: int) -> Any:
    emitters: Any = importlib.import_module("qdax.core.emitters.standard_emitters")
    return emitters.MixingEmitter(lambda x, key: x, variation(), 1.0, batch)


CRITIC = {
    "critic_hidden_layer_size": (16,),
    "num_critic_training_steps": 5,
    "num_pg_training_steps": 5,
    "batch_size": 32,
    "replay_buffer_size": 4096,
    "policy_learning_rate": 5e-3,
}


def me(task: Setup) -> Any:
    return mixing(task, 16), task


def pga_me(task: Setup) -> Any:
    from qdax.core.emitters.pga_me_emitter import PGAMEConfig, PGAMEEmitter

    config = PGAMEConfig(env_batch_size=16, proportion_mutation_ga=0.5, **CRITIC)
    return PGAMEEmitter(config, task.policy, task.env, variation()), task


def qdpg(task: Setup) -> Any:
    from qdax.core.containers.archive import score_euclidean_novelty
    from qdax.core.emitters.dpg_emitter import DiversityPGConfig
    from qdax.core.emitters.qdpg_emitter import QDPGEmitter, QDPGEmitterConfig
    from qdax.core.emitters.qpg_emitter import QualityPGConfig

    novelty = functools.partial(
        score_euclidean_novelty, num_nearest_neighb=5, scaling_ratio=1.0
    )
    config = QDPGEmitterConfig(
        qpg_config=QualityPGConfig(env_batch_size=4, **CRITIC),
        dpg_config=DiversityPGConfig(env_batch_size=4, archive_max_size=256, **CRITIC),
        iso_sigma=0.05,
        line_sigma=0.1,
        ga_batch_size=8,
    )
    return QDPGEmitter(config, task.policy, task.env, novelty), task


def dcrl_me(task: Setup) -> Any:
    from qdax.core.emitters.dcrl_me_emitter import DCRLMEConfig, DCRLMEEmitter
    from qdax.core.neuroevolution.buffers.buffer import DCRLTransition
    from qdax.core.neuroevolution.networks.networks import MLPDC
    from qdax.tasks.brax.v1 import descriptor_extractor, reward_offset
    from qdax.tasks.brax.v1.env_creators import create_brax_scoring_fn
    from qdax.tasks.brax.v1.wrappers.reward_wrappers import (
        ClipRewardWrapper,
        OffsetRewardWrapper,
    )

    env = OffsetRewardWrapper(task.env, offset=reward_offset[task.name])
    env = ClipRewardWrapper(env, clip_min=0.0)
    unknown = jnp.full((task.env.descriptor_length,), jnp.nan)

    def play_step(state: Any, params: Any, key: Any) -> Any:
        actions = task.policy.apply(params, state.obs)
        following = env.step(state, actions)
        transition = DCRLTransition(
            obs=state.obs,
            next_obs=following.obs,
            rewards=following.reward,
            dones=following.done,
            truncations=following.info["truncation"],
            actions=actions,
            state_desc=state.info["state_descriptor"],
            next_state_desc=following.info["state_descriptor"],
            desc=unknown,
            desc_prime=unknown,
        )
        return following, params, key, transition

    score = create_brax_scoring_fn(
        env,
        task.policy,
        descriptor_extractor[task.name],
        jax.random.key(0),
        play_step,
        task.episode_length,
    )
    config = DCRLMEConfig(ga_batch_size=8, dcrl_batch_size=4, ai_batch_size=4, **CRITIC)
    actor = MLPDC(
        layer_sizes=(8, task.env.action_size),
        kernel_init=jax.nn.initializers.lecun_uniform(),
        final_activation=jnp.tanh,
    )
    emitter = DCRLMEEmitter(config, task.policy, actor, env, variation())
    return emitter, task._replace(env=env, score=score)


def me_es(task: Setup) -> Any:
    from qdax.core.emitters.mees_emitter import MEESConfig, MEESEmitter

    config = MEESConfig(
        sample_number=32, num_optimizer_steps=2, learning_rate=0.1, sample_sigma=0.1
    )
    emitter = MEESEmitter(config, 20, task.score, task.env.descriptor_length)
    one = jax.tree.map(lambda x: x[:1], task.params)
    return emitter, task._replace(params=one)


def cma_me(task: Setup) -> Any:
    from jax.flatten_util import ravel_pytree
    from qdax.core.emitters.cma_improvement_emitter import CMAImprovementEmitter
    from qdax.core.emitters.cma_pool_emitter import CMAPoolEmitter

    flat = jax.vmap(lambda params: ravel_pytree(params)[0])(task.params)
    unravel = ravel_pytree(jax.tree.map(lambda x: x[0], task.params))[1]

    def score(genotypes: Any, key: Any) -> Any:
        fitnesses, descriptors, _ = task.score(jax.vmap(unravel)(genotypes), key)
        return fitnesses, descriptors, {}

    emitter = CMAImprovementEmitter(
        batch_size=16,
        genotype_dim=flat.shape[1],
        centroids=centroids(task),
        sigma_g=0.1,
        min_count=1,
    )
    pool = CMAPoolEmitter(num_states=2, emitter=emitter)
    return pool, task._replace(params=flat, score=score)


def centroids(task: Setup) -> Any:
    from qdax.core.containers.mapelites_repertoire import compute_cvt_centroids

    low, high = (np.asarray(limit) for limit in task.env.descriptor_limits)
    if task.name in ("ant_omni", "anttrap"):
        low, high = np.full(2, -1.0), np.full(2, 1.0)  # what 24 steps can reach [m]
    return compute_cvt_centroids(
        len(low), 1000, 64, low.tolist(), high.tolist(), jax.random.key(5)
    )


TASKS = ("ant_uni", "walker2d_uni", "pointmaze", "ant_omni", "anttrap")
ALGORITHMS = (me, pga_me, dcrl_me, qdpg, me_es, cma_me)


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_archive_grows_and_its_best_improves(algorithm: Any, name: str) -> None:
    from qdax.core.map_elites import MAPElites
    from qdax.utils.metrics import default_qd_metrics

    emitter, task = algorithm(setup(name))
    offset = newton_qd.tables.reward_offset[name] * task.episode_length
    map_elites = MAPElites(
        task.score, emitter, functools.partial(default_qd_metrics, qd_offset=offset)
    )
    key, init_key = jax.random.split(jax.random.key(3))
    repertoire, state, first = map_elites.init(task.params, centroids(task), init_key)
    update = jax.jit(map_elites.update)
    last = first
    for _ in range(20):
        key, subkey = jax.random.split(key)
        repertoire, state, last = update(repertoire, state, subkey)
    assert last["coverage"] > first["coverage"]
    assert last["max_fitness"] > first["max_fitness"]
    assert last["qd_score"] > first["qd_score"]
