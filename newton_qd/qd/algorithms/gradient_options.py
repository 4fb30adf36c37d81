"""Options of the algorithms of ``evolve`` that follow gradients through the physics."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

from newton_qd.gradients.factories import make_episode_gradient, make_mixed_gradient
from newton_qd.gradients.flow import GradientOptions
from newton_qd.gradients.smooth import with_smooth_descriptor
from newton_qd.qd.algorithms.parts import refused_options, settings
from newton_qd.qd.config import EvolveConfig
from newton_qd.qd.scoring.task import Task

# A robot that falls ends its episode, which no gradient sees: short steps only.
_FALLS: Mapping[str, Any] = {"shortest": 0.0005, "longest": 0.02, "sigma_g": 0.02}

TUNED: Mapping[str, Mapping[str, Any]] = {
    # Its return is chaotic after some ten control steps.
    "halfcheetah_uni": {"window": 10, "clip": 0.0, "longest": 1.0},
    "hopper_uni": _FALLS,
    "walker2d_uni": _FALLS,
    "humanoid_uni": _FALLS,
    "humanoid_omni": _FALLS,
    "humanoidtrap": _FALLS,
}
"""Defaults of ``FlowOptions`` and its kind that differ for an environment."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FlowOptions:
    """How gradients come about; every algorithm here has these options.

    Attributes:
        window: Control steps after which the gradient is cut; 0: never.
        clip: Largest norm of the adjoint of a state; 0: no limit.
        discount: Factor of the adjoint for each control step that it goes back [-].
        smooth_width: Share of a robot's weight over which the reading of a foot has a
            gradient [-]; its value stays 0 or 1.
        initial_scale: Factor of the weights of the initial population [-]: small
            feedback keeps gradients small over more control steps.
    """

    window: int = 0
    clip: float = 10.0
    discount: float = 1.0
    smooth_width: float = 0.1
    initial_scale: float = 1.0

    def flow(self) -> GradientOptions:
        """The options of a gradient, in the fastest way, that keeps intermediates.

        Raises:
            ValueError: A value is out of its range.
        """
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
    noise: float = 0.02

    @property
    def estimator(self) -> Any:
        """Builds the gradient, as ``make_gradient_scoring_function`` wants it."""
        if not self.samples:
            return make_episode_gradient
        return functools.partial(
            make_mixed_gradient, samples=self.samples, sigma=self.noise
        )

    @property
    def episodes(self) -> int:
        """Episodes that are differentiated for one gradient."""
        return 2 * self.samples or 1


def flow_options(kind: Any, config: EvolveConfig) -> Any:
    """Options of a run that differentiates whole episodes, checked.

    Args:
        kind: ``FlowOptions`` or a class of its kind.
        config: Settings of the run.

    Raises:
        ConfigError: There is no option of this name, or its value is not allowed.
    """
    names = {field.name for field in dataclasses.fields(kind)}
    tuned = TUNED.get(config.env_name, {}).items()
    options = settings(kind, config, **{k: v for k, v in tuned if k in names})
    with refused_options():
        options.flow()
    return options


def differentiable(task: Task, smooth_width: float) -> Task:
    """The task with a descriptor of the same values that has a gradient."""
    env = with_smooth_descriptor(task.env, smooth_width, straight_through=True)
    return dataclasses.replace(task, env=env)
