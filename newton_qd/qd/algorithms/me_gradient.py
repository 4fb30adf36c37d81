"""MAP-Elites with gradient variations."""

from __future__ import annotations

import dataclasses
from typing import Any

from newton_qd.qd.algorithms.gradient_options import (
    CHAOTIC,
    FlowOptions,
    differentiable,
    initial_scale,
    on_robots_that_fall,
)
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext, batch_and
from newton_qd.qd.algorithms.variation import parents_in, with_isoline
from newton_qd.qd.config import EvolveConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class MEGradientOptions(FlowOptions):
    """Options of MAP-Elites with gradient variations.

    Attributes:
        share: Share of a generation that follows gradients [-]; the rest are iso+line
            variations.
        branches: Offspring along each gradient.
        shortest: Shortest step, in units of policy weights [-].
        longest: Longest step, in units of policy weights [-].
        steered: Share of the parents that move towards empty cells [-]; the others
            increase their fitness.
    """

    share: float = 0.5
    branches: int = 4
    shortest: float = 0.02
    longest: float = 0.5
    steered: float = 0.5

    def parents(self, config: EvolveConfig) -> int:
        """Returns the number of parents with a gradient in each generation.

        Raises:
            ConfigError: A generation is too small, or a value is out of its range.
        """
        return parents_in(config, self.share, self.branches)


def _make(context: EmitterContext, options: MEGradientOptions) -> Any:
    """MAP-Elites with a share of the offspring along gradients of elites."""
    from newton_qd.qd.emitters.gradient_line import GradientLineEmitter
    from newton_qd.qd.scoring.rollout import episode_of

    config, key = context.config, context.reset_key
    task = differentiable(context.task, options)
    length = config.episode_length
    episode = episode_of(task, context.policy, length, options=options.flow())
    emitter = GradientLineEmitter(
        lambda genotypes, ways, _: episode.directional(genotypes, ways, key),
        parents=options.parents(config),
        branches=options.branches,
        shortest=options.shortest,
        longest=options.longest,
        steered=options.steered,
    )
    return with_isoline(emitter, config)


def _gradients(config: EvolveConfig, options: MEGradientOptions) -> int:
    return options.parents(config)


ME_GRADIENT = AlgorithmSpec(
    name="me-gradient",
    summary="MAP-Elites; half of the offspring are steps along exact gradients of "
    "elites, which either increase fitness or lead to empty cells",
    make=_make,
    options=MEGradientOptions,
    tuned={
        "halfcheetah_uni": {**CHAOTIC, "longest": 1.0},
        **on_robots_that_fall(shortest=0.0005, longest=0.02),
    },
    evaluations=batch_and(_gradients),
    gradients=_gradients,
    initial_scale=initial_scale,
)
