"""Elites that climb along gradients of whole episodes, as a part of an algorithm."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.qd.algorithms.gradient_options import (
    DifferentiableOptions,
    differentiable,
)
from newton_qd.qd.algorithms.spec import EmitterContext
from newton_qd.qd.config import ConfigError

if TYPE_CHECKING:  # importing a list of algorithms imports no JAX
    from newton_qd.qd.emitters.ascent import AscentEmitter


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClimbingOptions(DifferentiableOptions):
    """Options of algorithms with elites that climb.

    Attributes:
        climbers: Number of elites that climb at a time; each is one offspring of a
            generation. 0: none.
        climb_steps: Steps of a climber, one in each generation; then it begins again at
            a random elite.
        climb_shortest: Shortest step, in units of policy weights [-].
        climb_longest: Longest step, in units of policy weights [-].
        climb_momentum: Share of the former direction in a step [-].
        climb_worlds: Start states of each gradient.
        climb_window: Control steps after which this gradient is cut; 0: never.
        climb_termination_width: Width of the gradient of ``done`` at the limits of a
            healthy robot [m or rad]; with 0, a climber does not see that a fall is
            near.
    """

    climbers: int = 0
    climb_steps: int = 32
    climb_shortest: float = 0.005
    climb_longest: float = 0.05
    climb_momentum: float = 0.7
    climb_worlds: int = 1
    climb_window: int = 0
    climb_termination_width: float = 0.03

    def check(self) -> None:
        """Checks the climbers.

        Raises:
            ValueError: A value is out of its range.
        """
        for name in ("climb_steps", "climb_worlds"):
            checks.integer(name, getattr(self, name), most=None)
        if not 0 < self.climb_shortest <= self.climb_longest:
            given = self.climb_shortest, self.climb_longest
            name = "climb_shortest, climb_longest"
            raise ValueError(message(name, given, "0 < shortest <= longest"))
        checks.number("climb_momentum", self.climb_momentum, least=0, below=1)
        checks.number("climb_termination_width", self.climb_termination_width, least=0)

    @property
    def climbing_episodes(self) -> int:
        """Returns the number of differentiated episodes of a generation."""
        return self.climbers * self.climb_worlds


def ascent_emitter(
    context: EmitterContext, options: ClimbingOptions, most: int
) -> AscentEmitter:
    """Returns the emitter of the climbers of an algorithm.

    Args:
        context: What the run gives to its algorithm.
        options: Options of the algorithm, with at least one climber.
        most: Largest number of climbers.

    Raises:
        ConfigError: There are more climbers than a generation can contain.
        ValueError: A value is out of its range.
    """
    from newton_qd.gradients import GradientOptions
    from newton_qd.qd.emitters.ascent import AscentEmitter, mean_slope
    from newton_qd.qd.scoring.rollout import episode_of

    if options.climbers > most:
        allowed = (
            f"at most {most}, the rest of batch_size = {context.config.batch_size}"
        )
        raise ConfigError(message("options: climbers", options.climbers, allowed))
    task = differentiable(context.task, options, options.climb_termination_width)
    # only the return is differentiated
    task = dataclasses.replace(task, descriptor_extractor=None)
    flow: Any = GradientOptions(
        window=options.climb_window or None, checkpoint_every=None
    )
    length = context.config.episode_length
    episode = episode_of(task, context.policy, length, options=flow)
    return AscentEmitter(
        mean_slope(episode, options.climb_worlds),
        climbers=options.climbers,
        lifetime=options.climb_steps,
        shortest=options.climb_shortest,
        longest=options.climb_longest,
        momentum=options.climb_momentum,
    )
