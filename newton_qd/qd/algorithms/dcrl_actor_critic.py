"""DCRL-ME whose generations alternate with those of actors."""

from __future__ import annotations

import dataclasses
from typing import Any

from newton_qd.qd.algorithms.dcrl_me import DCRLMEOptions, dcrl_emitter
from newton_qd.qd.algorithms.gradient_options import initial_scale
from newton_qd.qd.algorithms.me_actor_critic import (
    ActorCriticOptions,
    actor_emitter,
    evaluations,
    gradients,
)
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext


@dataclasses.dataclass(frozen=True, kw_only=True)
class DCRLActorCriticOptions(ActorCriticOptions):
    """Options of generations of DCRL-ME and of actors, in turn.

    Attributes:
        alone: Generations of the actors before the first one of DCRL-ME.
        every: After that, one of so many generations is one of the actors; 0: none.
        follow_rate: Learning rate of elites that follow the critic [-].
        replay_steps: Updates of the critic in a generation of DCRL-ME.
        replay_size: Transitions in the replay buffer.
        follow_iso_sigma: As ``iso_sigma``, in generations of DCRL-ME.
        follow_line_sigma: As ``line_sigma``, in generations of DCRL-ME.
    """

    alone: int = 0
    every: int = 2
    follow_rate: float = 5e-3
    replay_steps: int = 1000
    replay_size: int = 1_000_000
    follow_iso_sigma: float = 0.005
    follow_line_sigma: float = 0.05


def _make(context: EmitterContext, options: DCRLActorCriticOptions) -> Any:
    """Generations of DCRL-ME and of actors, in turn."""
    from newton_qd.qd.emitters.in_turn import InTurn

    config = dataclasses.replace(
        context.config,
        iso_sigma=options.follow_iso_sigma,
        line_sigma=options.follow_line_sigma,
    )
    own = DCRLMEOptions(
        policy_learning_rate=options.follow_rate,
        num_critic_training_steps=options.replay_steps,
        replay_buffer_size=options.replay_size,
    )
    follower = dcrl_emitter(dataclasses.replace(context, config=config), own)
    actors = actor_emitter(context, options)
    return InTurn(actors, follower, alone=options.alone, every=options.every)


DCRL_ACTOR_CRITIC = AlgorithmSpec(
    name="dcrl-actor-critic",
    summary="`me-actor-critic` and `dcrl-me` in turn",
    make=_make,
    options=DCRLActorCriticOptions,
    least=1,
    transitions=True,
    evaluations=evaluations,
    gradients=gradients,
    initial_scale=initial_scale,
    double=False,
)
