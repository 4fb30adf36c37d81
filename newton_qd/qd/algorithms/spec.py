"""The spec of an algorithm of ``evolve``, and the context of its emitter."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Generic, TypeAlias

from newton_qd.checks import message
from newton_qd.qd.algorithms.options import OptionsT, check_effect, read_options
from newton_qd.qd.config import ConfigError, EvolveConfig

if TYPE_CHECKING:  # importing a list of algorithms imports no JAX
    import jax

    from newton_qd.qd.scoring.rollout import Policy
    from newton_qd.qd.scoring.task import Task
    from newton_qd.types import ScoringFunction

_DEFAULTS = EvolveConfig()

Evaluations: TypeAlias = Callable[[EvolveConfig, Any], int]
"""Maps settings and options to a number of episodes of one generation."""


@dataclasses.dataclass(frozen=True)
class EmitterContext:
    """Everything that a run gives to its algorithm to make the emitter.

    Attributes:
        config: Settings.
        task: Environment and descriptor.
        policy: Policy whose weights are the genotypes.
        score: Scoring function of genotypes (N, size) and a key. The key has no effect
            unless each generation has new start states: all evaluations of a run begin
            in the same states.
        reset_key: Key of the reset to these states.
        centroids: (cells, D) centres of the cells.
    """

    config: EvolveConfig
    task: Task
    policy: Policy
    score: Callable[[Any, Any], Any]
    reset_key: jax.Array
    centroids: jax.Array


def _batch_size(config: EvolveConfig, options: Any) -> int:
    del options
    return config.batch_size


def _unscaled(options: Any) -> float:
    del options
    return 1.0


def batch_and(gradients: Evaluations) -> Evaluations:
    """Returns the function that adds a batch to differentiated episodes beside it."""
    return lambda config, options: config.batch_size + gradients(config, options)


@dataclasses.dataclass(frozen=True, kw_only=True)
class AlgorithmSpec(Generic[OptionsT]):
    """An algorithm of ``evolve``: an emitter for QDax, and data for the loop.

    Attributes:
        name: Name of the algorithm in the settings of a run.
        summary: Description in one sentence.
        make: Makes the emitter; raises ``ConfigError`` or ``ValueError`` for options
            that do not fit the run.
        options: Dataclass of the options of this algorithm.
        tuned: Defaults of options that depend on the environment, by its name.
        least: Smallest value of an integer option.
        transitions: Whether its emitter learns from the steps of the episodes.
        evaluates: Whether its emitter itself evaluates individuals.
        evaluations: Number of episodes of one generation, with those that are
            differentiated.
        evaluates_first: Whether its emitter evaluates as many individuals of its own
            before its first generation as in each one.
        gradients: Number of differentiated episodes of one generation; ``None``: the
            algorithm does not use gradients of the physics.
        from_one_start: Number of episodes of one generation from a single start state,
            however many an individual has; ``None``: those that the emitter
            differentiates.
        scoring: Makes the scoring function of the loop; ``None``: the one without
            gradients.
        takes_faulty: Whether the emitter gets the fitness ``-inf`` of a faulty
            individual. If not, it gets the worst finite fitness.
        initial_scale: Factor of the weights of the initial population.
        varies: Whether its generations have iso+line variations, so that a tournament
            has an effect.
        smallest: Smallest number of individuals of a generation.
        double: Whether the emitter runs in JAX's 64-bit mode.
        goes_on: Whether a run goes on beyond its end. If not, its state depends on the
            number of generations.
    """

    name: str
    summary: str
    make: Callable[[EmitterContext, OptionsT], Any]
    options: type[OptionsT]
    tuned: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    least: int = 0
    transitions: bool = False
    evaluates: bool = False
    evaluations: Callable[[EvolveConfig, OptionsT], int] = _batch_size
    evaluates_first: bool = False
    gradients: Callable[[EvolveConfig, OptionsT], int] | None = None
    from_one_start: Callable[[EvolveConfig, OptionsT], int] | None = None
    scoring: (
        Callable[[EvolveConfig, OptionsT, Task, Policy], ScoringFunction] | None
    ) = None
    takes_faulty: bool = False
    initial_scale: Callable[[OptionsT], float] = _unscaled
    varies: bool = True
    smallest: int = 1
    double: bool = True
    goes_on: bool = True

    def read_options(self, config: EvolveConfig) -> OptionsT:
        """Returns the options of a run, with the defaults of its environment.

        Raises:
            ConfigError: An option does not exist, its value is not allowed, or the run
                has tournaments, and the algorithm none.
        """
        if config.tournament > 1 and not self.varies:
            allowed = f"1 for {self.name!r}, which has no iso+line variations"
            raise ConfigError(message("tournament", config.tournament, allowed))
        tuned = self.tuned.get(config.env_name, {})
        return read_options(self.options, config, least=self.least, **tuned)

    def check_effect(self, config: EvolveConfig) -> None:
        """Checks that the settings and options of a new run have an effect.

        A run that an earlier version began may have others, and can be resumed.

        Raises:
            ConfigError: One has no effect, or is refused by ``read_options``.
        """
        check_effect(self.read_options(config), config)
        variation = () if self.varies else ("iso_sigma", "line_sigma")
        why = f"for {self.name!r}, which has no iso+line variations"
        _check_plain(config, variation, why)
        if config.starts == 1:
            _check_plain(config, ("statistic",), "with starts = 1")


def _check_plain(config: EvolveConfig, names: Iterable[str], why: str) -> None:
    """Checks that settings without an effect have their defaults.

    Raises:
        ConfigError: One has another value.
    """
    for name in names:
        value, default = getattr(config, name), getattr(_DEFAULTS, name)
        if value != default:
            allowed = f"{default!r}, the default, {why}"
            raise ConfigError(message(name, value, allowed))
