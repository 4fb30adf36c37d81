"""Generations whose compiled programs are the same for all seeds."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax

from newton_qd.checks import Fact, message, shown
from newton_qd.qd.algorithms import AlgorithmSpec, EmitterContext
from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.run.generation import Generation
from newton_qd.qd.scoring.checked import check_genotypes
from newton_qd.qd.scoring.rollout import Policy
from newton_qd.qd.scoring.task import Task
from newton_qd.types import PyTree, ScoringFunction


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Drawn:
    """What the seed of a run draws once.

    Attributes:
        reset_key: Key of the reset to the start state.
        emitter_key: Key of the emitter's first state.
        centroids: (cells, D) centres of the cells.
    """

    reset_key: jax.Array
    emitter_key: jax.Array
    centroids: jax.Array


@dataclasses.dataclass(frozen=True, eq=False)
class GenerationParts:
    """A generation without what the seed draws.

    The methods are those of :class:`Generation`, with ``drawn`` as the first argument.
    It is no constant of a compiled program, so JAX's cache on disk has the program of
    another seed.

    Attributes:
        algorithm: The algorithm.
        options: Its options.
        config: Settings of the run.
        task: Task to solve.
        policy: Policy whose weights are the genotypes.
        score: Scoring function of genotypes (N, size) and a key.
    """

    algorithm: AlgorithmSpec[Any]
    options: Any
    config: EvolveConfig
    task: Task
    policy: Policy
    score: ScoringFunction

    def of(self, drawn: Drawn) -> Generation:
        """Makes the emitter, and a generation with it.

        Raises:
            ConfigError: The algorithm makes something else.
        """

        def score_again(genotypes: jax.Array, key: jax.Array) -> PyTree:
            # an emitter's own evaluations
            start = key if self.config.new_starts else drawn.reset_key
            return self.score(genotypes, start)

        context = EmitterContext(
            self.config,
            self.task,
            self.policy,
            score_again,
            drawn.reset_key,
            drawn.centroids,
        )
        emitter = self.algorithm.make(context, self.options)
        if not hasattr(emitter, "emit"):
            name = f"make of {self.algorithm.name!r}"
            allowed = "a function that returns an emitter of QDax"
            given = Fact(f"one that returned {shown(emitter)}")
            raise ConfigError(message(name, given, allowed))
        return Generation(
            emitter,
            drawn.emitter_key,
            self.algorithm.takes_faulty,
            self.task.qd_offset(self.config.episode_length),
        )

    def propose(self, drawn: Drawn, *arguments: Any) -> PyTree:
        """Returns the next genotypes, and the emitter's data about them.

        Raises:
            ConfigError: The emitter proposes another number of individuals.
        """
        found = self.of(drawn).propose(*arguments)
        # an emitter that evaluates others itself may propose only its best one
        number = None if self.algorithm.evaluates else self.config.batch_size
        check_genotypes(found[0], self.algorithm.name, number, self.policy.size)
        return found

    def begin(self, drawn: Drawn, *arguments: Any) -> PyTree:
        """Returns archive, emitter's state and metrics at the start."""
        return self.of(drawn).begin(*arguments)

    def tell(self, drawn: Drawn, *arguments: Any) -> PyTree:
        """Returns archive, emitter's state and metrics after a generation."""
        return self.of(drawn).tell(*arguments)
