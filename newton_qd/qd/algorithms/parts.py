"""What the algorithms of ``evolve`` are made of: the rows of their table."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import typing
from collections.abc import Callable, Iterator
from typing import Any

import jax

from newton_qd.qd.config import (
    ConfigError,
    EvolveConfig,
    check_integer,
    check_integers,
    check_number,
)
from newton_qd.qd.scoring.rollout import Policy, ScoringFunction
from newton_qd.qd.scoring.task import Task


@dataclasses.dataclass(frozen=True)
class Parts:
    """What an emitter may be made of.

    Attributes:
        config: Settings.
        task: Environment and descriptor.
        policy: Policy whose weights are the genotypes.
        score: Scoring function of genotypes (N, size) and a key that is not used:
            all evaluations of a run begin in one state.
        reset_key: Key of the reset to that state.
        centroids: (cells, D) centres of the cells.
    """

    config: EvolveConfig
    task: Task
    policy: Policy
    score: Callable[[Any, Any], Any]
    reset_key: jax.Array
    centroids: jax.Array


def _batch_size(config: EvolveConfig) -> int:
    return config.batch_size


@dataclasses.dataclass(frozen=True)
class Algorithm:
    """One row of ``ALGORITHMS``.

    Attributes:
        make: Makes the emitter; raises ``ConfigError`` for options that it does not
            have.
        transitions: Whether its emitter learns from the steps of the episodes.
        evaluates: Whether its emitter evaluates individuals as it learns.
        evaluations: Episodes of one generation, given the settings; an episode that
            is differentiated counts as one, too.
        gradients: Those of them that are differentiated.
        scoring: Makes the scoring function of the loop; ``None``: the plain one.
        takes_faulty: Whether the emitter hears of the fitness ``-inf`` of a faulty
            individual; if not, it hears of the worst finite one.
        initial_scale: Factor of the weights of the initial population.
        smallest: Least individuals of a generation.
        double: Whether the emitter runs in JAX's 64-bit mode.
    """

    make: Callable[[Parts], Any]
    transitions: bool = False
    evaluates: bool = False
    evaluations: Callable[[EvolveConfig], int] = _batch_size
    gradients: Callable[[EvolveConfig], int] = lambda config: 0
    scoring: Callable[[EvolveConfig, Task, Policy], ScoringFunction] | None = None
    takes_faulty: bool = False
    initial_scale: Callable[[EvolveConfig], float] = lambda config: 1.0
    smallest: int = 1
    double: bool = True


@contextlib.contextmanager
def refused_options() -> Iterator[None]:
    """What refuses a value in here refuses an option.

    Raises:
        ConfigError: A value was refused.
    """
    try:
        yield
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"options: {error}") from error


def settings(
    kind: Any, config: EvolveConfig, *, least: int = 0, **defaults: Any
) -> Any:
    """Fills the settings of an emitter with the options of a run.

    Args:
        kind: Dataclass of the settings.
        config: Settings of the run.
        least: Least value of a setting that is an integer.
        **defaults: Settings that differ from those of the dataclass.

    Raises:
        ConfigError: There is no option of this name, its value is of another type
            than the setting, not finite, negative or less than ``least``.
    """
    types = typing.get_type_hints(kind)
    allowed = {field.name for field in dataclasses.fields(kind)}
    for name, value in config.options:
        if name not in allowed:
            raise ConfigError(
                f"options: {config.algorithm!r} has no {name!r}; allowed: "
                f"{', '.join(sorted(allowed)) or 'none'}"
            )
        defaults[name] = _fitting(name, value, types[name], least)
    return kind(**defaults)


def _fitting(name: str, value: Any, wanted: Any, least: int) -> Any:
    """The value of an option in the type of its setting."""
    name = f"options: {name}"
    if wanted is float:
        check_number(name, value)
        return float(value)
    if wanted is int:
        check_integer(name, value, least)
    elif wanted is bool:
        if not isinstance(value, bool):
            raise ConfigError(f"{name} must be true or false, got {value!r}")
    elif typing.get_origin(wanted) is tuple:
        check_integers(name, value, 1)
    else:
        raise TypeError(f"{name}: a setting of type {wanted} cannot be an option")
    return value


def isoline(config: EvolveConfig) -> Any:
    """The iso+line variation (Vassiliades and Mouret 2018) of a run."""
    from qdax.core.emitters.mutation_operators import isoline_variation

    return functools.partial(
        isoline_variation, iso_sigma=config.iso_sigma, line_sigma=config.line_sigma
    )


def isoline_emitter(config: EvolveConfig, batch_size: int) -> Any:
    """Emitter of iso+line variations, as MAP-Elites has it."""
    from qdax.core.emitters.standard_emitters import MixingEmitter

    return MixingEmitter(
        mutation_fn=_no_mutation,
        variation_fn=isoline(config),
        variation_percentage=1.0,
        batch_size=batch_size,
    )


def _no_mutation(genotypes: Any, key: jax.Array) -> Any:
    del key
    return genotypes
