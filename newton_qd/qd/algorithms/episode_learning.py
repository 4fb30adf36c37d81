"""Options of actors that learn from whole episodes after some generations."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from newton_qd import checks
from newton_qd.qd.algorithms.gradient_options import (
    DifferentiableOptions,
    differentiable,
)
from newton_qd.qd.algorithms.options import only_with

if TYPE_CHECKING:  # importing a list of algorithms imports no JAX
    from newton_qd.qd.emitters.actor_critic_learner import ActorCritic
    from newton_qd.qd.emitters.episode_learner import EpisodeLearning
    from newton_qd.qd.scoring.task import Task

_MOST = 2**30  # JAX counts in 32 bits
_NARROWEST = 1e-6  # of the gradient of a fall


@dataclasses.dataclass(frozen=True, kw_only=True)
class EpisodeLearningOptions(DifferentiableOptions):
    """Options of actors that learn from whole episodes after some generations.

    Attributes:
        episodes_after: Generations after which actors learn from the exact gradient of
            whole episodes, in place of windows with a critic; 0: never.
        episode_updates: Updates of an actor from episodes before each production of
            offspring.
        episode_weight_noise: Standard deviation of the noise of weights in episodes, in
            units of the genotype.
        episode_termination_width: Width of the gradient of ``done`` in episodes [m or
            rad]; with 0, an actor does not see that a fall is near.
    """

    episodes_after: int = 0
    episode_updates: int = only_with("episodes_after", 1)
    episode_weight_noise: float = only_with("episodes_after", 0.02)
    episode_termination_width: float = only_with("episodes_after", 0.03)

    def check(self) -> None:
        """Checks how actors learn from episodes.

        Raises:
            ValueError: A value is out of its range.
        """
        checks.integer("episodes_after", self.episodes_after, least=0, most=_MOST)
        checks.integer("episode_updates", self.episode_updates)
        checks.number("episode_weight_noise", self.episode_weight_noise, least=0)
        if self.episode_termination_width:
            name = "episode_termination_width"
            checks.number(name, self.episode_termination_width, least=_NARROWEST)
        super().check()


def episode_learning(
    task: Task, options: EpisodeLearningOptions, method: ActorCritic
) -> EpisodeLearning | None:
    """Returns how actors learn from episodes, or ``None`` if they never do.

    Args:
        task: The task.
        options: Options of the algorithm.
        method: Learning method of the actors before.
    """
    if not options.episodes_after:
        return None
    from newton_qd.qd.emitters.episode_learner import EpisodeLearning

    width = options.episode_termination_width
    return EpisodeLearning(
        method,
        differentiable(task, options, width).env,
        after=options.episodes_after,
        updates=options.episode_updates,
        weight_noise=options.episode_weight_noise,
        averaged=not task.reads_end,
    )
