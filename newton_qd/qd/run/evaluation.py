"""Evaluates genotypes of a run again, as the run did or from other start states."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.qd.algorithms import ALGORITHMS, algorithm_named
from newton_qd.qd.config import EvolveConfig
from newton_qd.qd.scoring.robust import robust, run_scoring
from newton_qd.qd.scoring.rollout import Policy, episode_of
from newton_qd.qd.scoring.task import Task
from newton_qd.types import RNGKey, ScoringFunction


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Results of elites that were evaluated again.

    N is the number of cells and K the number of keys. A single cell has no axis N, and
    a single key no axis K.

    Attributes:
        cells: (N,) rows of the archive.
        fitnesses: (N, K) fitnesses, ``-inf`` after a fault.
        descriptors: (N, K, D) descriptors.
    """

    cells: np.ndarray
    fitnesses: np.ndarray
    descriptors: np.ndarray


class Evaluator:
    """Evaluates genotypes in batches of the size of a generation.

    One size is compiled once. It is the size of the run, because sums of a policy could
    depend on it.

    Args:
        config: Settings of the run.
        task: The task.
        policy: Policy whose weights are the genotypes.
        start_key: Key of the reset of the run.
    """

    def __init__(
        self, config: EvolveConfig, task: Task, policy: Policy, start_key: RNGKey
    ) -> None:
        self._config = config
        self._task = task
        self._policy = policy
        self._start_key = start_key

    def as_in_run(self, genotypes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns fitnesses (N,) and descriptors (N, D) from the start of the run.

        Args:
            genotypes: (N, size) weights.
        """
        key = self._start_key
        return self._batched(genotypes, lambda some, _: self._score(some, key)[:2])

    def from_keys(
        self, genotypes: np.ndarray, keys: RNGKey
    ) -> tuple[np.ndarray, np.ndarray]:
        """Evaluates each genotype from each key.

        Args:
            genotypes: (N, size) weights.
            keys: Key or (K,) keys of the reset.

        Returns:
            Fitnesses (N, K) and descriptors (N, K, D); for a single key (N,) and
            (N, D).
        """
        # keys of the old kind are integers (2,)
        old = not jnp.issubdtype(keys.dtype, jax.dtypes.prng_key)
        shape = keys.shape[:-1] if old else keys.shape
        flat = keys.reshape((-1, keys.shape[-1]) if old else (-1,))
        each = jnp.tile(flat, (len(genotypes), 1) if old else len(genotypes))
        fitnesses, found = self._batched(
            np.repeat(genotypes, len(flat), axis=0),
            lambda some, rows: self._pairs(some, each[rows]),
        )
        leading = (len(genotypes), *shape)
        return fitnesses.reshape(leading), found.reshape(*leading, -1)

    @functools.cached_property
    def _score(self) -> ScoringFunction:
        """The scoring function of the loop, without gradients, compiled.

        Those of the package have the same values with gradients; a registered
        algorithm may score differently.
        """
        config, spec = self._config, algorithm_named(self._config.algorithm)
        if spec in ALGORITHMS or spec.scoring is None:
            return jax.jit(run_scoring(config, self._task, self._policy))
        options = spec.read_options(config)
        score = spec.scoring(config, options, self._task, self._policy)
        return jax.jit(robust(score, config, self._task))

    @functools.cached_property
    def _pairs(self) -> Callable[[jax.Array, jax.Array], tuple]:
        """Evaluates genotypes (N, size), each from its own key (N,)."""
        episode = episode_of(self._task, self._policy, self._config.episode_length)

        def pairs(genotypes: jax.Array, keys: jax.Array) -> tuple:
            found = jax.vmap(episode)(genotypes, keys)
            return found.fitness, found.descriptor

        return jax.jit(pairs)

    def _batched(
        self,
        genotypes: np.ndarray,
        evaluate: Callable[[jax.Array, np.ndarray], tuple],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Calls a function with genotypes of one batch and their rows."""
        size, count = self._config.batch_size, len(genotypes)
        fitnesses, descriptors = [], []
        for begin in range(0, count, size):
            rows = np.minimum(np.arange(begin, begin + size), count - 1)
            fitness, descriptor = evaluate(jnp.asarray(genotypes[rows]), rows)
            fitnesses.append(np.asarray(fitness))
            descriptors.append(np.asarray(descriptor))
        return np.concatenate(fitnesses)[:count], np.concatenate(descriptors)[:count]
