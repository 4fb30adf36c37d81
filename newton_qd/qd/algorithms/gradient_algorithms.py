"""The algorithms of ``evolve`` that follow gradients through the physics."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

from newton_qd.gradients.factories import make_directional_gradient
from newton_qd.qd.algorithms.gradient_options import (
    FlowOptions,
    MixedOptions,
    differentiable,
    flow_options,
)
from newton_qd.qd.algorithms.me_actor_critic import ME_ACTOR_CRITIC
from newton_qd.qd.algorithms.parts import Algorithm, Parts, isoline_emitter
from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.scoring.gradient_scoring import make_gradient_scoring_function
from newton_qd.qd.scoring.rollout import Policy, ScoringFunction
from newton_qd.qd.scoring.task import Task

_SMALLEST_POPULATION = 3  # a solution point and two offspring


def _scoring(
    options: MixedOptions, config: EvolveConfig, task: Task, policy: Policy
) -> ScoringFunction:
    """Scores with the gradients of fitness and descriptor."""
    return make_gradient_scoring_function(
        differentiable(task, options.smooth_width),
        policy,
        config.episode_length,
        options.flow(),
        estimator=options.estimator,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class MEGradientOptions(FlowOptions):
    """Options of MAP-Elites with gradient variations.

    Attributes:
        share: Share of a generation that follows gradients [-]; the rest are iso+line
            variations.
        branches: Offspring along each gradient.
        shortest: Shortest step, in units of policy weights [-].
        longest: Longest step.
        steered: Share of the parents that steer towards empty cells [-]; the others
            climb their fitness.
    """

    share: float = 0.5
    branches: int = 4
    shortest: float = 0.02
    longest: float = 0.5
    steered: float = 0.5

    def parents(self, config: EvolveConfig) -> int:
        """Parents of a generation whose gradient is evaluated.

        Raises:
            ConfigError: A generation is too small, or a value out of its range.
        """
        if not 0 < self.share <= 1:
            raise ConfigError(f"options: share must be in (0, 1], got {self.share!r}")
        if self.branches < 1:
            raise ConfigError(
                f"options: branches must be at least 1, got {self.branches!r}"
            )
        parents = int(self.share * config.batch_size) // self.branches
        if parents < 1:
            raise ConfigError(
                f"options: share = {self.share} of batch_size = {config.batch_size} "
                f"holds no parent with branches = {self.branches} offspring"
            )
        return parents


def _me_gradient(parts: Parts) -> Any:
    """MAP-Elites in which a share of the offspring lies along gradients of elites."""
    from qdax.core.emitters.multi_emitter import MultiEmitter

    from newton_qd.qd.emitters.gradient_line import GradientLineEmitter

    config = parts.config
    options = flow_options(MEGradientOptions, config)
    task = differentiable(parts.task, options.smooth_width)
    gradient = make_directional_gradient(
        task.env,
        parts.policy.apply,
        task.descriptor_extractor,
        episode_length=config.episode_length,
        unravel=parts.policy.unravel,
        options=options.flow(),
    )
    parents = options.parents(config)
    emitter = GradientLineEmitter(
        lambda genotypes, ways, _: gradient(genotypes, ways, parts.reset_key),
        parents=parents,
        branches=options.branches,
        shortest=options.shortest,
        longest=options.longest,
        steered=options.steered,
    )
    rest = config.batch_size - emitter.batch_size
    if not rest:
        return emitter
    return MultiEmitter((emitter, isoline_emitter(config, rest)))


def _me_gradients(config: EvolveConfig) -> int:
    return flow_options(MEGradientOptions, config).parents(config)


@dataclasses.dataclass(frozen=True, kw_only=True)
class OMGMEGAOptions(MixedOptions):
    """Options of OMG-MEGA.

    Attributes:
        sigma_g: Standard deviation of the coefficients of the normalized gradients, in
            units of policy weights [-].
    """

    sigma_g: float = 0.1


def _omg_mega(parts: Parts) -> Any:
    """OMG-MEGA: random steps along all gradients of elites."""
    from newton_qd.qd.emitters import OMGMEGAEmitter

    options = flow_options(OMGMEGAOptions, parts.config)
    return OMGMEGAEmitter(parts.config.batch_size, options.sigma_g)


def _omg_mega_scoring(
    config: EvolveConfig, task: Task, policy: Policy
) -> ScoringFunction:
    return _scoring(flow_options(OMGMEGAOptions, config), config, task, policy)


def _omg_mega_gradients(config: EvolveConfig) -> int:
    return config.batch_size * flow_options(OMGMEGAOptions, config).episodes


@dataclasses.dataclass(frozen=True, kw_only=True)
class CMAMEGAOptions(MixedOptions):
    """Options of CMA-MEGA.

    Attributes:
        points: Solution points, among which a generation is divided.
        sigma_g: Initial standard deviation of the coefficients of the normalized
            gradients, in units of policy weights [-].
        adam: Learning rate of Adam [-]; 0: points move to the weighted mean of their
            best offspring.
        restart_period: Restart a point after this many generations in any case; 0:
            by its restart rule alone.
    """

    points: int = 4
    sigma_g: float = 0.1
    adam: float = 0.0
    restart_period: int = 0

    def population(self, config: EvolveConfig) -> int:
        """Individuals of a generation that belong to one solution point.

        Raises:
            ConfigError: The points do not divide a generation, or are too many.
        """
        if self.points < 1 or config.batch_size % self.points:
            raise ConfigError(
                f"options: points must divide batch_size = {config.batch_size}, got "
                f"{self.points!r}"
            )
        each = config.batch_size // self.points
        if each < _SMALLEST_POPULATION:
            raise ConfigError(
                f"options: points = {self.points} leave {each} of batch_size = "
                f"{config.batch_size} each; at least {_SMALLEST_POPULATION}"
            )
        return each


@dataclasses.dataclass(frozen=True, kw_only=True)
class CMAMAEGAOptions(CMAMEGAOptions):
    """Options of CMA-MAEGA.

    Attributes:
        learning_rate: Rate at which the threshold of a cell rises, 0 to 1 [-].
    """

    learning_rate: float = 0.01


def _arborescence(kind: Any, options: CMAMEGAOptions, parts: Parts) -> Any:
    """An emitter of solution points with the options of a run."""
    import optax

    config = parts.config
    score = _scoring(options, config, parts.task, parts.policy)
    return kind(
        lambda genotypes, _: score(genotypes, parts.reset_key),
        sigma_g=options.sigma_g,
        batch_size=options.population(config),
        num_emitters=options.points,
        optimizer=optax.adam(options.adam) if options.adam else None,
        restart_period=options.restart_period or None,
    )


def _cma_mega(parts: Parts) -> Any:
    """CMA-MEGA: CMA-ES searches for steps along the gradients of solution points."""
    from newton_qd.qd.emitters import CMAMEGAEmitter

    options = flow_options(CMAMEGAOptions, parts.config)
    return _arborescence(CMAMEGAEmitter, options, parts)


def _cma_maega(parts: Parts) -> Any:
    """CMA-MAEGA: the same on an annealed archive."""
    from newton_qd.qd.emitters import CMAMAEGAEmitter
    from newton_qd.qd.emitters.annealed import OnAnnealedRepertoire

    options = flow_options(CMAMAEGAOptions, parts.config)
    return OnAnnealedRepertoire(
        _arborescence(CMAMAEGAEmitter, options, parts),
        learning_rate=options.learning_rate,
        # The worst return that the QD score counts as positive.
        threshold_min=-parts.task.reward_offset * parts.config.episode_length,
    )


def _points(kind: Any, config: EvolveConfig) -> int:
    options = flow_options(kind, config)
    return options.points * options.episodes


def _scale(kind: Any, config: EvolveConfig) -> float:
    return flow_options(kind, config).initial_scale


def _row(make: Any, kind: Any) -> Algorithm:
    """A row for an emitter that evaluates the gradients of its solution points."""
    return Algorithm(
        make,
        evaluations=lambda config: config.batch_size + _points(kind, config),
        gradients=functools.partial(_points, kind),
        takes_faulty=True,
        initial_scale=functools.partial(_scale, kind),
    )


GRADIENT_ALGORITHMS: Mapping[str, Algorithm] = {
    "me-gradient": Algorithm(
        _me_gradient,
        evaluations=lambda config: config.batch_size + _me_gradients(config),
        gradients=_me_gradients,
        initial_scale=functools.partial(_scale, MEGradientOptions),
    ),
    "me-actor-critic": ME_ACTOR_CRITIC,
    "omg-mega": Algorithm(
        _omg_mega,
        evaluations=_omg_mega_gradients,
        gradients=_omg_mega_gradients,
        scoring=_omg_mega_scoring,
        takes_faulty=True,
        initial_scale=functools.partial(_scale, OMGMEGAOptions),
    ),
    "cma-mega": _row(_cma_mega, CMAMEGAOptions),
    "cma-maega": _row(_cma_maega, CMAMAEGAOptions),
}
"""Their rows of the table of algorithms."""
