"""DCRL-ME with actors that learn over short horizons."""

from __future__ import annotations

import dataclasses
from typing import Any

from newton_qd.qd.algorithms.dcrl_me import conditioned_actor, transitions_of
from newton_qd.qd.algorithms.gradient_options import initial_scale
from newton_qd.qd.algorithms.me_actor_critic import (
    ActorCriticOptions,
    actors_of,
    evaluations,
    gradients,
)
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext
from newton_qd.qd.algorithms.variation import isoline_emitter


@dataclasses.dataclass(frozen=True, kw_only=True)
class DCRLActorCriticOptions(ActorCriticOptions):
    """Options of actors beside the emitter of DCRL-ME.

    Attributes:
        followers: Elites that follow the critic of all episodes, in a generation.
        injected: Individuals from the actor of this critic, in a generation.
        follow_steps: Updates of an elite that follows the critic.
        follow_rate: Learning rate of these elites [-].
        replay_steps: Updates of this critic in a generation.
        replay_rows: Transitions of one update.
        replay_size: Transitions in the replay buffer, also in checkpoints.
        lengthscale: Distance of descriptors at which a reward is smaller by a factor e.
    """

    followers: int = 16
    injected: int = 16
    follow_steps: int = 150
    follow_rate: float = 1e-3
    replay_steps: int = 1000
    replay_rows: int = 100
    replay_size: int = 100_000
    lengthscale: float = 0.1


def _make(context: EmitterContext, options: DCRLActorCriticOptions) -> Any:
    """Elites that follow a critic of all episodes, actors, and iso+line variations.

    Raises:
        ConfigError: A generation is too small for the offspring of both.
    """
    from newton_qd import compat

    compat.install()  # QDax's file imports environments that fail with today's JAX
    from qdax.core.emitters.dcrl_emitter import DCRLConfig, DCRLEmitter
    from qdax.core.emitters.multi_emitter import MultiEmitter

    from newton_qd.qd.algorithms.each_episode import EachEpisode
    from newton_qd.qd.algorithms.network_emitter import OfParameters, Part

    config, task = context.config, context.task
    own = options.followers + options.injected
    actors = actors_of(context, options, config.batch_size - own)

    def made(times: int) -> Any:
        """Returns the emitter for generations so many times as large."""
        return DCRLEmitter(
            DCRLConfig(
                dcrl_batch_size=times * options.followers,
                ai_batch_size=times * options.injected,
                lengthscale=options.lengthscale,
                num_critic_training_steps=options.replay_steps,
                num_pg_training_steps=options.follow_steps,
                batch_size=options.replay_rows,
                replay_buffer_size=options.replay_size,
                policy_learning_rate=options.follow_rate,
            ),
            context.policy.network,
            conditioned_actor(config, task),
            task.env,
        )

    emitter: Any = made(1)
    if config.starts > 1:
        emitter = EachEpisode(emitter, made(config.starts), config.starts)
    learner = OfParameters(emitter, context.policy, transitions_of(task))
    first: Any = Part(learner, own)  # takes the first individuals for its own
    rest = config.batch_size - own - actors.batch_size
    last = (isoline_emitter(config, rest),) if rest else ()
    return MultiEmitter((first, actors, *last))


DCRL_ACTOR_CRITIC = AlgorithmSpec(
    name="dcrl-actor-critic",
    summary="`me-actor-critic` and `dcrl-me` in one: some individuals are offspring of "
    "actors that learn from gradients of the physics, others follow a critic that "
    "learns from all episodes",
    make=_make,
    options=DCRLActorCriticOptions,
    transitions=True,
    evaluations=evaluations,
    gradients=gradients,
    initial_scale=initial_scale,
    double=False,
)
