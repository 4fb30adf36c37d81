"""The learning method of the actors of an algorithm."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from newton_qd.qd.algorithms.gradient_options import (
    DifferentiableOptions,
    differentiable,
)
from newton_qd.qd.algorithms.spec import EmitterContext
from newton_qd.qd.emitters.actor_critic_settings import ActorCriticSettings

if TYPE_CHECKING:  # importing a list of algorithms imports no JAX
    from newton_qd.qd.emitters.actor_critic_learner import ActorCritic
    from newton_qd.qd.scoring.task import Task


@dataclasses.dataclass(frozen=True, kw_only=True)
class LearningOptions(DifferentiableOptions, ActorCriticSettings):
    """Options of an algorithm whose actors learn over short windows."""


def learning_method(
    context: EmitterContext, options: LearningOptions
) -> tuple[Task, ActorCritic]:
    """Returns the task with a smooth descriptor, and how actors learn on it.

    Args:
        context: What the run gives to its algorithm.
        options: Options of the algorithm.
    """
    from newton_qd.qd.emitters import ActorCritic
    from newton_qd.qd.emitters.actor_critic_learner import measure_of
    from newton_qd.qd.emitters.whitening import Whitening

    policy, task = (
        context.policy,
        differentiable(context.task, options, options.termination_width),
    )
    method = ActorCritic(
        task.env,
        policy.of_weights,
        measure_of(task),
        context.config.episode_length,
        options,
        Whitening.of(policy) if options.whiten else Whitening(),
    )
    return task, method
