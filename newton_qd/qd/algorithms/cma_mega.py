"""CMA-MEGA, and code that it shares with CMA-MAEGA."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from newton_qd.checks import message
from newton_qd.qd.algorithms.gradient_options import (
    CHAOTIC,
    MixedOptions,
    gradient_scoring,
    initial_scale,
    on_robots_that_fall,
)
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext, batch_and
from newton_qd.qd.config import ConfigError, EvolveConfig

if TYPE_CHECKING:
    from newton_qd.qd.emitters.arborescence import ArborescenceEmitter

_SMALLEST_POPULATION = 3  # a solution point and two offspring

TUNED = {"halfcheetah_uni": CHAOTIC, **on_robots_that_fall(sigma_g=0.02)}
"""Defaults of ``CMAMEGAOptions`` that depend on the environment."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CMAMEGAOptions(MixedOptions):
    """Options of CMA-MEGA (Fontaine and Nikolaidis 2021).

    Attributes:
        points: Number of solution points that share a generation equally.
        sigma_g: Initial standard deviation of the coefficients of the normalized
            gradients, in units of policy weights [-].
        adam: Learning rate of Adam [-]; 0: points move to the weighted mean of their
            best offspring.
        restart_period: Restart each point after this many generations; 0: only by its
            restart rule.
    """

    points: int = 4
    sigma_g: float = 0.1
    adam: float = 0.0
    restart_period: int = 0


def population_of(points: int, config: EvolveConfig) -> int:
    """Returns the number of individuals of a generation for one solution point.

    Args:
        points: Number of solution points.
        config: Settings of the run.

    Raises:
        ConfigError: A generation cannot be divided by the number of points, or there
            are too many points.
    """
    if points < 1 or config.batch_size % points:
        allowed = f"divisors of batch_size = {config.batch_size}"
        raise ConfigError(message("options: points", points, allowed))
    each = config.batch_size // points
    if each < _SMALLEST_POPULATION:
        why = f"which leave {each} of batch_size = {config.batch_size} each"
        allowed = f"at least {_SMALLEST_POPULATION} for each point"
        raise ConfigError(message("options: points", points, allowed, why=why))
    return each


def make_search(
    kind: type[ArborescenceEmitter], context: EmitterContext, options: CMAMEGAOptions
) -> ArborescenceEmitter:
    """Makes an emitter with solution points from the options of a run."""
    import optax

    config = context.config
    score = gradient_scoring(config, options, context.task, context.policy)
    return kind(
        lambda genotypes, _: score(genotypes, context.reset_key),
        sigma_g=options.sigma_g,
        batch_size=population_of(options.points, config),
        num_emitters=options.points,
        optimizer=optax.adam(options.adam) if options.adam else None,
        restart_period=options.restart_period or None,
    )


def gradients(config: EvolveConfig, options: CMAMEGAOptions) -> int:
    """Returns the number of differentiated episodes: those of solution points."""
    del config
    return options.points * options.episodes


def _make(context: EmitterContext, options: CMAMEGAOptions) -> Any:
    """CMA-MEGA: CMA-ES searches for steps along the gradients of solution points."""
    from newton_qd.qd.emitters import CMAMEGAEmitter

    return make_search(CMAMEGAEmitter, context, options)


CMA_MEGA = AlgorithmSpec(
    name="cma-mega",
    summary="CMA-MEGA: CMA-ES searches for steps along the gradients of a few solution "
    "points",
    make=_make,
    options=CMAMEGAOptions,
    varies=False,
    tuned=TUNED,
    evaluations=batch_and(gradients),
    evaluates_first=True,
    gradients=gradients,
    takes_faulty=True,
    initial_scale=initial_scale,
)
