"""QDax's reinforcement learning and AURORA on this library's environments.

The tests of each algorithm are those that QDax's examples show, with small networks
and short training.
"""

# QDax's annotations differ from what its functions take and return.
# pyright: reportArgumentType=false, reportCallIssue=false
from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import pytest

import newton_qd.compat

# QDax and what it imports warn about their own use of other packages.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]

WORLDS, EPISODE, SKILLS = 20, 50, 5
SMALL = {
    "critic_hidden_layer_size": (32,),
    "policy_hidden_layer_size": (32,),
    "batch_size": 64,
    "discount": 0.95,
}
AGENT = {**SMALL, "episode_length": EPISODE, "learning_rate": 3e-3, "tau": 0.01}


@pytest.fixture(scope="module", autouse=True)
def installed() -> Iterator[None]:
    newton_qd.compat.install()
    yield
    newton_qd.compat.uninstall()


@functools.cache
def environment(**options: Any) -> Any:
    from qdax.tasks.brax.v1 import create

    return create("pointmaze", episode_length=EPISODE, batch_size=WORLDS, **options)


def sac() -> Any:
    from qdax.baselines.sac import SAC, SacConfig

    return SAC(SacConfig(**AGENT), environment().action_size), {}


def td3() -> Any:
    from qdax.baselines.td3 import TD3, TD3Config

    config = TD3Config(
        episode_length=EPISODE,
        critic_learning_rate=3e-3,
        policy_learning_rate=3e-3,
        **SMALL,
    )
    return TD3(config, environment().action_size), {}


def diayn() -> Any:
    from qdax.baselines.diayn import DIAYN, DiaynConfig

    config = DiaynConfig(num_skills=SKILLS, descriptor_full_state=False, **AGENT)
    return DIAYN(config, environment().action_size), {"descriptor_size": 2}


def diayn_smerl() -> Any:
    from qdax.baselines.diayn_smerl import DIAYNSMERL, DiaynSmerlConfig

    config = DiaynSmerlConfig(
        num_skills=SKILLS,
        descriptor_full_state=False,
        diversity_reward_scale=2.0,
        smerl_margin=20,
        smerl_target=-60,
        **AGENT,
    )
    return DIAYNSMERL(config, environment().action_size), {"descriptor_size": 2}


def dads_smerl() -> Any:
    from qdax.baselines.dads_smerl import DADSSMERL, DadsSmerlConfig

    config = DadsSmerlConfig(
        num_skills=SKILLS,
        dynamics_update_freq=1,
        normalize_target=True,
        omit_input_dynamics_dim=2,
        diversity_reward_scale=2.0,
        smerl_margin=20,
        smerl_target=-60,
        **AGENT,
    )
    agent = DADSSMERL(config, environment().action_size, 2)
    return agent, {"descriptor_size": 2}


def buffer(skills: int, smerl: bool) -> Any:
    from qdax.core.neuroevolution.buffers.buffer import QDTransition, ReplayBuffer
    from qdax.core.neuroevolution.buffers.trajectory_buffer import TrajectoryBuffer

    env = environment()
    dummy = QDTransition.init_dummy(
        env.observation_size + skills, env.action_size, env.descriptor_length
    )
    if smerl:
        return TrajectoryBuffer.init(5_000, dummy, WORLDS, EPISODE)
    return ReplayBuffer.init(5_000, dummy)


@pytest.mark.parametrize("make", [sac, td3, diayn, diayn_smerl, dads_smerl])
def test_training_raises_the_return(make: Any) -> None:
    from qdax.core.neuroevolution.sac_td3_utils import do_iteration_fn, warmstart_buffer

    agent, sizes = make()
    env, watched = environment(), environment(eval_metrics=True)
    keys = jax.random.split(jax.random.key(0), 3)
    state = jax.jit(env.reset)(rng=keys[0])
    first = jax.jit(watched.reset)(rng=keys[1])
    training = agent.init(
        keys[2],
        action_size=env.action_size,
        observation_size=env.observation_size,
        **sizes,
    )
    given: dict[str, Any] = {}
    evaluation: dict[str, Any] = {}
    if sizes:
        given["skills"] = jnp.tile(jnp.eye(SKILLS), (WORLDS // SKILLS, 1))
        evaluation["env_batch_size"] = WORLDS
    play = functools.partial(agent.play_step_fn, env=env, deterministic=False, **given)
    play_evaluation = functools.partial(
        agent.play_step_fn, env=watched, deterministic=True, **given
    )
    evaluate = jax.jit(
        functools.partial(
            agent.eval_policy_fn,
            play_step_fn=play_evaluation,
            eval_env_first_state=first,
            **evaluation,
        )
    )
    store, state, training = warmstart_buffer(
        replay_buffer=buffer(SKILLS if sizes else 0, "smerl" in make.__name__),
        training_state=training,
        env_state=state,
        num_warmstart_steps=1_000,
        env_batch_size=WORLDS,
        play_step_fn=play,
    )
    iteration = functools.partial(
        do_iteration_fn,
        env_batch_size=WORLDS,
        grad_updates_per_step=0.1 if "smerl" in make.__name__ else 0.2,
        play_step_fn=play,
        update_fn=agent.update,
    )

    @jax.jit
    def train(carry: Any) -> Any:
        return jax.lax.scan(lambda c, _: (iteration(*c)[:3], None), carry, None, 200)[0]

    before = evaluate(training_state=training)
    training, state, store = train((training, state, store))
    after = evaluate(training_state=training)
    assert jnp.isfinite(after[0])
    # The goal is 1.5 away, behind two walls; an untrained policy stays far from it.
    assert after[0] > before[0]


TRAINED, VARIED, EACH = 2, 6, 5  # agents that learn, that vary, and worlds of one


def pbt_emitter(agent: Any, env: Any) -> Any:
    from qdax.core.emitters.pbt_me_emitter import PBTEmitter, PBTEmitterConfig
    from qdax.core.emitters.pbt_variation_operators import td3_pbt_variation_fn

    config = PBTEmitterConfig(
        buffer_size=1_000,
        num_training_iterations=4,
        env_batch_size=EACH,
        grad_updates_per_step=1.0,
        pg_population_size_per_device=TRAINED,
        ga_population_size_per_device=VARIED,
        num_devices=1,
        fraction_best_to_replace_from=0.5,
        fraction_to_replace_from_best=0.5,
        fraction_to_replace_from_samples=0.5,
        fraction_sort_exchange=0.1,
    )
    variation = functools.partial(td3_pbt_variation_fn, iso_sigma=0.05, line_sigma=0.1)
    return PBTEmitter(agent, config, env, variation)


def pbt_score(agent: Any) -> Any:
    from qdax.tasks.brax.v1 import create, descriptor_extractor

    single = create("pointmaze", episode_length=EPISODE, batch_size=1)
    first = jax.jit(single.reset)(rng=jax.random.key(1))
    evaluate = agent.get_eval_qd_fn(single, descriptor_extractor["pointmaze"])

    def score(genotypes: Any, key: Any) -> Any:
        count = jax.tree.leaves(genotypes)[0].shape[0]
        states = jax.tree.map(lambda x: jnp.repeat(x[None], count, axis=0), first)
        returns, descriptors, _, _ = evaluate(genotypes, states)
        return returns, descriptors, {}

    return score


def pbt_population(agent: Any, env: Any, keys: Any, devices: Any) -> Any:
    make = agent.get_init_fn(
        TRAINED + VARIED, env.action_size, env.observation_size, 1000
    )
    agents, _ = jax.pmap(make, axis_name="p", devices=devices)(keys)
    empty = jax.vmap(type(agents).empty_optimizers_states)
    return jax.pmap(empty, axis_name="p", devices=devices)(agents)


def test_populations_train_in_map_elites() -> None:
    from qdax.baselines.td3_pbt import PBTTD3, PBTTD3Config
    from qdax.core.containers.mapelites_repertoire import compute_cvt_centroids
    from qdax.core.distributed_map_elites import DistributedMAPElites
    from qdax.tasks.brax.v1 import create, reward_offset
    from qdax.utils.metrics import default_qd_metrics

    env = create("pointmaze", episode_length=EPISODE, batch_size=EACH * TRAINED)
    settings = {name: value for name, value in SMALL.items() if name != "discount"}
    agent = PBTTD3(PBTTD3Config(episode_length=EPISODE, **settings), env.action_size)
    metrics = functools.partial(
        default_qd_metrics, qd_offset=reward_offset["pointmaze"] * EPISODE
    )
    map_elites = DistributedMAPElites(
        pbt_score(agent), pbt_emitter(agent, env), metrics
    )
    devices = jax.devices("cpu")[:1]
    keys = jax.random.key_data(jax.random.split(jax.random.key(2), 1))
    centroids = compute_cvt_centroids(2, 1000, 64, -1.0, 1.0, jax.random.key(3))
    init = map_elites.get_distributed_init_fn(devices=devices, centroids=centroids)
    repertoire, state, begin = init(
        genotypes=pbt_population(agent, env, keys, devices), key=keys
    )
    update = map_elites.get_distributed_update_fn(num_iterations=1, devices=devices)
    end = begin
    for _ in range(10):
        repertoire, state, end = update(repertoire, state, keys)
    for name in ("coverage", "max_fitness", "qd_score"):
        assert jnp.max(end[name]) > jnp.max(begin[name]), name


def test_aurora_fills_an_archive_without_descriptors() -> None:
    from qdax.core.aurora import AURORA
    from qdax.core.emitters.mutation_operators import isoline_variation
    from qdax.core.emitters.standard_emitters import MixingEmitter
    from qdax.custom_types import AuroraExtraInfoNormalization
    from qdax.tasks.brax.descriptor_extractors import get_aurora_encoding
    from qdax.tasks.brax.v1.env_creators import (
        create_default_brax_task_components,
        get_aurora_scoring_fn,
    )
    from qdax.utils import train_seq2seq
    from qdax.utils.metrics import default_qd_metrics

    env, policy, score = create_default_brax_task_components(
        "walker2d_uni", jax.random.key(0), 24, (8,)
    )
    params = jax.vmap(policy.init)(
        jax.random.split(jax.random.key(1), 12), jnp.zeros((12, env.observation_size))
    )
    model = train_seq2seq.get_model(env.observation_size, True, hidden_size=3)
    aurora = AURORA(
        scoring_function=get_aurora_scoring_fn(score, lambda x: x.obs[:, ::8], "seen"),
        emitter=MixingEmitter(
            lambda x, key: x,
            functools.partial(isoline_variation, iso_sigma=0.05, line_sigma=0.1),
            1.0,
            12,
        ),
        metrics_function=functools.partial(default_qd_metrics, qd_offset=0.0),
        encoder_function=jax.jit(functools.partial(get_aurora_encoding, model=model)),
        training_function=functools.partial(
            train_seq2seq.lstm_ae_train, model=model, batch_size=8
        ),
        observations_key="seen",
    )
    weights = train_seq2seq.get_initial_params(
        model, jax.random.key(2), (1, 3, env.observation_size)
    )
    zeros = jnp.zeros(env.observation_size)
    info = AuroraExtraInfoNormalization.create(weights, zeros, zeros + 1.0)
    repertoire, state, first, info = aurora.init(
        params, info, jnp.asarray(0.02), 64, jax.random.key(3)
    )
    repertoire, info = aurora.train(repertoire, weights, 0, jax.random.key(4))
    update, last = jax.jit(aurora.update), first
    for key in jax.random.split(jax.random.key(5), 10):
        repertoire, state, last = update(repertoire, state, key, aurora_extra_info=info)
    assert last["coverage"] > first["coverage"]
    assert last["max_fitness"] > first["max_fitness"]
