"""DCRL-ME with actors that learn over short horizons."""

from __future__ import annotations

import dataclasses
from typing import Any

from newton_qd.qd.algorithms.dcrl_me import transitions_for
from newton_qd.qd.algorithms.gradient_options import initial_scale
from newton_qd.qd.algorithms.me_actor_critic import (
    ActorCriticOptions,
    actors_of,
    evaluations,
    gradients,
    require_room,
)
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext
from newton_qd.qd.algorithms.variation import isoline_emitter
from newton_qd.qd.config import EvolveConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class DCRLActorCriticOptions(ActorCriticOptions):
    """Options of actors beside the emitter of DCRL-ME.

    Attributes:
        followers: Elites that follow the critic of the replay buffer, in a generation.
        injected: Individuals from the actor of the replay buffer, in a generation.
        follow_steps: Updates of an elite that follows the critic.
        follow_rate: Learning rate of these elites [-].
        replay_steps: Updates of the critic of the replay buffer in a generation.
        replay_rows: Transitions of one update.
        replay_size: Transitions in the replay buffer, also in checkpoints.
        lengthscale: Distance of descriptors at which a reward of the replay buffer is
            smaller by a factor e.
    """

    followers: int = 16
    injected: int = 8
    follow_steps: int = 100
    follow_rate: float = 1e-3
    replay_steps: int = 300
    replay_rows: int = 256
    replay_size: int = 100_000
    lengthscale: float = 0.1


def _make(context: EmitterContext, options: DCRLActorCriticOptions) -> Any:
    """Actors, elites that follow a critic of all episodes, and iso+line variations.

    Raises:
        ConfigError: A generation is too small for the offspring of the actors and of
            the replay buffer.
    """
    import jax
    import jax.numpy as jnp

    from newton_qd import compat

    compat.install()  # QDax's file imports environments that fail with today's JAX
    from qdax.core.emitters.dcrl_emitter import DCRLConfig, DCRLEmitter
    from qdax.core.emitters.multi_emitter import MultiEmitter
    from qdax.core.neuroevolution.networks.networks import MLPDC

    from newton_qd.qd.algorithms.network_emitter import PartOfParameters

    config, task = context.config, context.task
    actors = actors_of(context, options)
    others = options.followers + options.injected
    rest = require_room(config, options, actors.batch_size + others)
    dcrl = DCRLEmitter(
        DCRLConfig(
            dcrl_batch_size=options.followers,
            ai_batch_size=options.injected,
            lengthscale=options.lengthscale,
            num_critic_training_steps=options.replay_steps,
            num_pg_training_steps=options.follow_steps,
            batch_size=options.replay_rows,
            replay_buffer_size=options.replay_size,
            policy_learning_rate=options.follow_rate,
        ),
        context.policy.network,
        MLPDC(
            layer_sizes=(*config.hidden, task.env.action_size),
            kernel_init=jax.nn.initializers.lecun_uniform(),
            final_activation=jnp.tanh,
        ),
        task.env,
    )
    part = PartOfParameters(dcrl, context.policy, transitions_for(task))
    # the emitter of DCRL-ME knows the order: its own offspring, then all others
    emitters = (part, actors, *([isoline_emitter(config, rest)] if rest else []))
    return MultiEmitter(emitters)


DCRL_ACTOR_CRITIC = AlgorithmSpec(
    name="dcrl-actor-critic",
    summary="`me-actor-critic` with the emitter of DCRL-ME beside the actors: its critic "
    "learns from all episodes, and elites follow it",
    make=_make,
    options=DCRLActorCriticOptions,
    transitions=True,
    evaluations=evaluations,
    gradients=gradients,
    initial_scale=initial_scale,
    double=False,
)
