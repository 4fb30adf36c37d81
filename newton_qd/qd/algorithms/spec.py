"""What an algorithm of ``evolve`` is, and what its emitter is made of."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Generic

from newton_qd.qd.algorithms.options import OptionsT, read_options
from newton_qd.qd.config import EvolveConfig

if TYPE_CHECKING:  # importing a list of algorithms imports no JAX
    import jax

    from newton_qd.qd.scoring.rollout import Policy
    from newton_qd.qd.scoring.task import Task
    from newton_qd.types import ScoringFunction


@dataclasses.dataclass(frozen=True)
class EmitterContext:
    """What a run gives to the emitter of its algorithm.

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


def _batch_size(config: EvolveConfig, options: Any) -> int:
    del options
    return config.batch_size


def _unscaled(options: Any) -> float:
    del options
    return 1.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class AlgorithmSpec(Generic[OptionsT]):
    """An algorithm of ``evolve``: an emitter of QDax, and what the loop asks of it.

    Attributes:
        name: Name by which a run asks for it.
        summary: What it is, in one sentence.
        make: Makes the emitter; raises ``ConfigError`` or ``ValueError`` for options
            that do not fit the run.
        options: Dataclass of the options that this algorithm alone has.
        tuned: Defaults of options that differ for an environment, by its name.
        least: Least value of an option that is an integer.
        transitions: Whether its emitter learns from the steps of the episodes.
        evaluates: Whether its emitter evaluates individuals as it learns.
        evaluations: Episodes of one generation; an episode that is differentiated
            counts as one, too.
        gradients: Those of them that are differentiated; ``None``: it does not follow
            gradients through the physics.
        scoring: Makes the scoring function of the loop; ``None``: the plain one.
        takes_faulty: Whether the emitter is told the fitness ``-inf`` of a faulty
            individual; if not, it is told the worst finite one.
        initial_scale: Factor of the weights of the initial population.
        smallest: Least individuals of a generation.
        double: Whether the emitter runs in JAX's 64-bit mode.
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
    gradients: Callable[[EvolveConfig, OptionsT], int] | None = None
    scoring: (
        Callable[[EvolveConfig, OptionsT, Task, Policy], ScoringFunction] | None
    ) = None
    takes_faulty: bool = False
    initial_scale: Callable[[OptionsT], float] = _unscaled
    smallest: int = 1
    double: bool = True

    def read_options(self, config: EvolveConfig) -> OptionsT:
        """Returns the options of a run, with the defaults of its environment.

        Raises:
            ConfigError: There is no option of this name, or its value is not allowed.
        """
        tuned = self.tuned.get(config.env_name, {})
        return read_options(self.options, config, least=self.least, **tuned)
