"""MAP-Elites as a pure step from generation to generation, built from QDax."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.qd.checkpoint import Checkpoint
from newton_qd.qd.config import ConfigError, EvolveConfig, settings_text
from newton_qd.qd.extras import require_extra
from newton_qd.qd.folder import COLUMNS
from newton_qd.qd.rollout import make_policy, make_scoring_function
from newton_qd.qd.task import Task

_CVT_SAMPLES_PER_CELL = 50
_CVT_MIN_SAMPLES = 10_000


class SearchError(RuntimeError):
    """The search cannot go on."""


@dataclasses.dataclass(frozen=True)
class SearchState:
    """An archive between two generations.

    Attributes:
        iteration: Generations that are finished; -1 before the initial population.
        repertoire: QDax's ``MapElitesRepertoire`` with flat genotypes.
        metrics: (iteration + 1, columns) one row per generation.
    """

    iteration: int
    repertoire: Any
    metrics: np.ndarray


class Search:
    """MAP-Elites with iso+line variation on one task.

    Generation ``i`` draws its random numbers from a key folded with ``i``; the state
    after it depends on the settings only.
    """

    def __init__(self, config: EvolveConfig, task: Task) -> None:
        """Builds the parts; compiles and evaluates nothing.

        Args:
            config: Settings with the grid filled in.
            task: Task to solve.

        Raises:
            MissingExtra: QDax is not installed.
        """
        require_extra("qdax", "qd")
        self._config = config
        self._task = task
        keys = jax.random.split(jax.random.key(config.seed), 4)
        self._key_centroids, self._key_reset = keys[0], keys[1]
        self._key_initial, self._key_generations = keys[2], keys[3]
        self._policy = make_policy(task.env, config.hidden)
        score = make_scoring_function(task, self._policy, config.episode_length)
        algorithm = _make_algorithm(config, task)

        def ask(repertoire: Any, key: jax.Array) -> jax.Array:
            genotypes, _ = algorithm.ask(repertoire, None, key)
            # Under x64 QDax draws its noise in double precision.
            return genotypes.astype(jnp.float32)

        def tell(repertoire: Any, genotypes: Any, fitnesses: Any, found: Any) -> Any:
            fitnesses = _break_ties(fitnesses, found, repertoire.centroids)
            told = algorithm.tell(genotypes, fitnesses, found, repertoire, None)
            return told[0], told[2]

        self._score = jax.jit(score)
        self._ask = jax.jit(ask)
        self._tell = jax.jit(tell)
        self._population = jax.jit(jax.vmap(self._policy.init))

    def empty(self) -> SearchState:
        """State before the initial population."""
        from qdax.core.containers.mapelites_repertoire import MapElitesRepertoire

        repertoire = MapElitesRepertoire.init_default(
            genotype=jnp.zeros((self._policy.size,), jnp.float32),
            centroids=jnp.asarray(self._centroids(), jnp.float32),
        )
        rows = np.zeros((0, len(COLUMNS)))
        return SearchState(iteration=-1, repertoire=repertoire, metrics=rows)

    def advance(self, state: SearchState) -> SearchState:
        """Evaluates one generation and puts it into the archive.

        Raises:
            SearchError: No individual of the initial population can be kept.
        """
        iteration = state.iteration + 1
        if iteration == 0:
            keys = jax.random.split(self._key_initial, self._config.batch_size)
            genotypes = self._population(keys)
        else:
            key = jax.random.fold_in(self._key_generations, iteration)
            genotypes = self._ask(state.repertoire, key)
        fitnesses, found, _ = self._score(genotypes, self._key_reset)
        repertoire, metrics = self._tell(state.repertoire, genotypes, fitnesses, found)
        evaluations = (iteration + 1) * self._config.batch_size
        row = {
            "iteration": iteration,
            "evaluations": evaluations,
            "env_steps": evaluations * self._config.episode_length,
            **{name: float(value) for name, value in metrics.items()},
        }
        if row["coverage"] == 0:
            raise SearchError(
                "no individual of the initial population has a finite return and "
                "descriptor: the environment is faulty for every one of them"
            )
        rows = np.vstack([state.metrics, [row[name] for name in COLUMNS]])
        return SearchState(iteration, repertoire, rows)

    def checkpoint(self, state: SearchState) -> Checkpoint:
        """Copies a state to the host."""
        repertoire = state.repertoire
        return Checkpoint(
            settings=settings_text(self._config),
            iteration=state.iteration,
            genotypes=np.asarray(repertoire.genotypes),
            fitnesses=np.asarray(repertoire.fitnesses)[:, 0],
            descriptors=np.asarray(repertoire.descriptors),
            centroids=np.asarray(repertoire.centroids),
            metrics=state.metrics,
        )

    def restore(self, checkpoint: Checkpoint) -> SearchState:
        """Makes the state that a checkpoint describes."""
        from qdax.core.containers.mapelites_repertoire import MapElitesRepertoire

        repertoire = MapElitesRepertoire(
            genotypes=jnp.asarray(checkpoint.genotypes),
            fitnesses=jnp.asarray(checkpoint.fitnesses[:, None]),
            extra_scores={},
            keys_extra_scores=(),
            descriptors=jnp.asarray(checkpoint.descriptors),
            centroids=jnp.asarray(checkpoint.centroids),
        )
        return SearchState(checkpoint.iteration, repertoire, checkpoint.metrics)

    def _centroids(self) -> np.ndarray:
        """(cells, D) centres of the cells."""
        from qdax.core.containers import mapelites_repertoire as qdax_containers

        low, high = self._task.limits
        if not (np.all(np.isfinite(low)) and np.all(low < high)):
            raise ConfigError(
                f"the descriptor of {self._config.env_name!r} has no finite box: "
                f"{low} to {high}"
            )
        if self._config.grid is not None:
            centroids = qdax_containers.compute_euclidean_centroids(
                self._config.grid, low.tolist(), high.tolist()
            )
            return np.asarray(centroids)
        return self._voronoi_centroids(low, high)

    def _voronoi_centroids(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        from qdax.core.containers.mapelites_repertoire import compute_cvt_centroids
        from threadpoolctl import threadpool_limits

        cells = self._config.centroids
        assert cells is not None
        # Threads add up the clusters in changing order: one keeps runs equal.
        with threadpool_limits(limits=1):
            centroids = compute_cvt_centroids(
                num_descriptors=len(low),
                num_init_cvt_samples=max(
                    _CVT_MIN_SAMPLES, _CVT_SAMPLES_PER_CELL * cells
                ),
                num_centroids=cells,
                minval=low.tolist(),
                maxval=high.tolist(),
                key=self._key_centroids,
            )
        return np.asarray(centroids)


def _make_algorithm(config: EvolveConfig, task: Task) -> Any:
    """QDax's MAP-Elites; asked and told, so the evaluation stays outside."""
    from functools import partial

    from qdax.core.emitters.mutation_operators import isoline_variation
    from qdax.core.emitters.standard_emitters import MixingEmitter
    from qdax.core.map_elites import MAPElites
    from qdax.utils.metrics import default_qd_metrics

    def no_mutation(genotypes: Any, key: jax.Array) -> Any:
        del key
        return genotypes

    variation: Any = partial(
        isoline_variation, iso_sigma=config.iso_sigma, line_sigma=config.line_sigma
    )
    emitter = MixingEmitter(
        mutation_fn=no_mutation,
        variation_fn=variation,
        variation_percentage=1.0,
        batch_size=config.batch_size,
    )
    offset = task.reward_offset * config.episode_length
    return MAPElites(
        scoring_function=None,
        emitter=emitter,
        metrics_function=partial(default_qd_metrics, qd_offset=offset),
    )


def _break_ties(
    fitnesses: jax.Array, descriptors: jax.Array, centroids: jax.Array
) -> jax.Array:
    """Keeps the first of several equally fit individuals of one cell.

    QDax would write all of them to the same row of the archive, in an order that XLA
    leaves open on a GPU.

    Args:
        fitnesses: (N,) returns.
        descriptors: (N, D) descriptors.
        centroids: (cells, D) centres of the cells.

    Returns:
        (N,) returns, ``-inf`` for the later ones.
    """
    from qdax.core.containers.mapelites_repertoire import get_cells_indices

    cells = get_cells_indices(descriptors, centroids)
    order = jnp.lexsort((fitnesses, cells))
    same = (cells[order][1:] == cells[order][:-1]) & (
        fitnesses[order][1:] == fitnesses[order][:-1]
    )
    later = jnp.concatenate([jnp.zeros((1,), bool), same])
    return jnp.where(jnp.zeros_like(later).at[order].set(later), -jnp.inf, fitnesses)
