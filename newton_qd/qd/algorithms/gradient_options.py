"""Options of the algorithms of ``evolve`` that use gradients of the physics."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from newton_qd.checks import message
from newton_qd.qd.algorithms.options import Options, only_with

if TYPE_CHECKING:  # importing the options imports no JAX
    from newton_qd.gradients import Episode, GradientOptions
    from newton_qd.gradients.exact import EpisodeGradient
    from newton_qd.qd.config import EvolveConfig
    from newton_qd.qd.scoring.rollout import Policy
    from newton_qd.qd.scoring.task import Task
    from newton_qd.types import ScoringFunction


@dataclasses.dataclass(frozen=True, kw_only=True)
class DifferentiableOptions(Options):
    """Options of every algorithm that differentiates an environment.

    Attributes:
        smooth_width: Share of a robot's weight over which the contact of a foot has a
            gradient [-]; its value stays 0 or 1.
        algebraic_tail: Whether this gradient decays with the inverse square of the
            load, instead of exponentially.
        initial_scale: Factor of the weights of the initial population [-]; with small
            weights, gradients stay small over more control steps.
    """

    smooth_width: float = 0.1
    algebraic_tail: bool = False
    initial_scale: float = 1.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class FlowOptions(DifferentiableOptions):
    """Options of algorithms that differentiate whole episodes.

    Attributes:
        window: Control steps after which the gradient is cut; 0: never.
        clip: Largest norm of the adjoint of a state; 0: no limit.
        discount: Factor of the adjoint for each control step on the way back [-].
    """

    window: int = 0
    clip: float = 10.0
    discount: float = 1.0

    def check(self) -> None:
        """Checks the settings of the gradient.

        Raises:
            ValueError: A value is out of its range.
        """
        self.flow()

    def flow(self) -> GradientOptions:
        """Returns the options of the gradient; it stores all intermediate values.

        Raises:
            ValueError: A value is out of its range.
        """
        from newton_qd.gradients import GradientOptions

        return GradientOptions(
            window=self.window or None,
            clip=self.clip or None,
            discount=self.discount,
            checkpoint_every=None,
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class MixedOptions(FlowOptions):
    """Options of algorithms that need the gradient of every component.

    Attributes:
        samples: Pairs of samples of the mixed gradient of first and zeroth order; 0:
            the exact gradient.
        noise: Standard deviation of these samples, in units of policy weights [-].
    """

    samples: int = 0
    noise: float = only_with("samples", 0.02)

    def gradient(self, episode: Episode) -> EpisodeGradient:
        """Returns the gradient of an episode: exact, or mixed with the zeroth order.

        Raises:
            TypeError: ``noise`` is not a number.
            ValueError: ``samples`` or ``noise`` is out of its range.
        """
        if not self.samples:
            return episode.gradient
        from newton_qd.gradients.mixed import check_mixture

        check_mixture(self.samples, self.noise)
        # the key is the same in all generations, and on all devices of a mesh: noise by
        # place would repeat the errors of earlier gradients
        return functools.partial(
            episode.mixed,
            samples=self.samples,
            sigma=self.noise,
            noise_by_genotype=True,
        )

    @property
    def episodes(self) -> int:
        """Returns the number of differentiated episodes for one gradient."""
        return 2 * self.samples or 1


# The return of a halfcheetah is chaotic after about ten control steps.
CHAOTIC: Mapping[str, Any] = {"window": 10, "clip": 0.0}

# The gradient doctor finds the first order better than the zeroth up to here.
WINDOW = 32
SHORT: Mapping[str, Any] = {"window": 8}
"""Default of the window for the halfcheetah."""


_SMOOTHED = ("smooth_width", "algebraic_tail")
"""Options that change the gradient of feet contact alone."""

MAZES = ("antmaze", "antmaze_u", "antmaze_big", "antmaze_hardest", "humanoid_maze")
"""Tasks with negative rewards, and with falls that end an episode."""


def on_robots_that_fall(**defaults: object) -> dict[str, Mapping[str, object]]:
    """Returns defaults for the robots that can fall.

    A fall ends the episode, and the gradient does not contain this. So these robots
    need short steps.

    Args:
        **defaults: Options with their defaults.
    """
    names = ("hopper_uni", "walker2d_uni", "humanoid_uni", "humanoid_omni")
    return dict.fromkeys((*names, "humanoidtrap"), defaults)


def differentiable(
    task: Task, options: DifferentiableOptions, termination_width: float = 0.0
) -> Task:
    """Returns the task with the same values, and with a gradient of its descriptor.

    Args:
        task: The task.
        options: Options of the gradient.
        termination_width: Width of the gradient of done [m or rad]; 0: no gradient.
    """
    from newton_qd.gradients import with_smooth_descriptor, with_smooth_termination

    tail = "algebraic" if options.algebraic_tail else "exponential"
    env = with_smooth_descriptor(task.env, options.smooth_width, True, tail)
    if termination_width:
        env = with_smooth_termination(env, termination_width)
    return dataclasses.replace(task, env=env)


def check_smoothed(config: EvolveConfig, options: Options, task: Task) -> None:
    """Checks that the options of smooth feet contact in a new run have an effect.

    Args:
        config: Settings of the run.
        options: Options of its algorithm.
        task: The task.

    Raises:
        ConfigError: The state descriptor of the task is not feet contact, and one of
            the options is given.
    """
    from newton_qd.envs.base import Env
    from newton_qd.qd.config import ConfigError
    from newton_qd.wrappers import FeetContactWrapper
    from newton_qd.wrappers.base import outermost

    if not isinstance(options, DifferentiableOptions):
        return
    if isinstance(task.env, Env) and outermost(task.env, FeetContactWrapper):
        return
    for name, value in config.options:
        if name in _SMOOTHED:
            why = f"which has no effect on {config.env_name!r}, without feet contact"
            allowed = "no value, or another environment"
            raise ConfigError(message(f"options: {name}", value, allowed, why=why))


def gradient_scoring(
    config: EvolveConfig, options: MixedOptions, task: Task, policy: Policy
) -> ScoringFunction:
    """Returns a scoring function with the gradients of fitness and descriptor."""
    from newton_qd.qd.scoring.rollout import episode_of

    smooth = differentiable(task, options)
    length = config.episode_length
    episode = episode_of(smooth, policy, length, options=options.flow())
    return episode.scoring(options.gradient(episode))


def initial_scale(options: DifferentiableOptions) -> float:
    """Returns the factor of the weights of the initial population."""
    return options.initial_scale
