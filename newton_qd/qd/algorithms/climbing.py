"""Elites that climb along gradients of whole episodes, as a part of an algorithm."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.qd.algorithms.gradient_options import MAZES, SHORT
from newton_qd.qd.algorithms.options import Options, only_with
from newton_qd.qd.algorithms.spec import EmitterContext
from newton_qd.qd.config import ConfigError

if TYPE_CHECKING:  # importing a list of algorithms imports no JAX
    from newton_qd.qd.emitters.ascent import AscentEmitter


_MOST_STEPS = 2**30  # JAX counts in 32 bits
_NARROWEST = 1e-6  # of the gradient of a fall

# The return of a halfcheetah is chaotic. In a maze, rewards are negative, so the
# gradient of a fall would point towards it.
CLIMBING: Mapping[str, Mapping[str, Any]] = {
    "halfcheetah_uni": {"climb_window": SHORT["window"]},
    **{name: {"climb_termination_width": 0.0} for name in MAZES},
}
"""Defaults of climbers that depend on the environment."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClimbingOptions(Options):
    """Options of algorithms with elites that climb.

    Attributes:
        climbers: Number of elites that climb at a time; each is one offspring of a
            generation. 0: none, which ``me-ascent`` refuses.
        climb_steps: Steps of a climber, one in each generation; then it begins again at
            a random elite.
        climb_shortest: Shortest step, in units of policy weights [-].
        climb_longest: Longest step, in units of policy weights [-].
        climb_momentum: Share of the former direction in a step [-].
        climb_worlds: Start states of each gradient; each step draws new ones.
        climb_window: Control steps after which this gradient is cut; 0: never.
        climb_termination_width: Width of the gradient of ``done`` at the limits of a
            healthy robot [m or rad]; with 0, a climber does not see that a fall is
            near. Use 0 if the rewards are negative.
    """

    climbers: int = 0
    climb_steps: int = only_with("climbers", 32)
    climb_shortest: float = only_with("climbers", 0.005)
    climb_longest: float = only_with("climbers", 0.05)
    climb_momentum: float = only_with("climbers", 0.7)
    climb_worlds: int = only_with("climbers", 1)
    climb_window: int = only_with("climbers", 0)
    climb_termination_width: float = only_with("climbers", 0.03)

    def check(self) -> None:
        """Checks the climbers.

        Raises:
            ValueError: A value is out of its range.
        """
        checks.integer("climb_steps", self.climb_steps, most=_MOST_STEPS)
        checks.integer("climb_worlds", self.climb_worlds)
        checks.number("climb_shortest", self.climb_shortest, above=0)
        checks.number("climb_longest", self.climb_longest, least=self.climb_shortest)
        checks.number("climb_momentum", self.climb_momentum, least=0, below=1)
        if self.climb_termination_width:
            name = "climb_termination_width"
            checks.number(name, self.climb_termination_width, least=_NARROWEST)

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
    from newton_qd.gradients import GradientOptions, with_smooth_termination
    from newton_qd.qd.emitters.ascent import AscentEmitter, mean_slope
    from newton_qd.qd.scoring.rollout import episode_of

    size = context.config.batch_size
    if options.climbers > most:
        rest = f", since actors have {size - most} of them" if most < size else ""
        allowed = f"at most {most} with batch_size = {size}{rest}"
        raise ConfigError(message("options: climbers", options.climbers, allowed))
    env = context.task.env
    if options.climb_termination_width:
        env = with_smooth_termination(env, options.climb_termination_width)
    # only the return is differentiated
    task = dataclasses.replace(context.task, env=env, descriptor_extractor=None)
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
