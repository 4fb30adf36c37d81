"""Algorithms as a pure step from one generation to the next, built with QDax."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from newton_qd.checks import message
from newton_qd.errors import require_extra
from newton_qd.gradients.episode_input import check_length
from newton_qd.qd.algorithms import AlgorithmSpec, algorithm_named
from newton_qd.qd.algorithms.options import refused_options
from newton_qd.qd.config import ConfigError, EvolveConfig, settings_text
from newton_qd.qd.run.archive import Archive, repertoire_of
from newton_qd.qd.run.cells import cell_centroids
from newton_qd.qd.run.checkpoint import Checkpoint
from newton_qd.qd.run.folder import COLUMNS, complete_metrics
from newton_qd.qd.run.generation_parts import Drawn, GenerationParts
from newton_qd.qd.run.leaves import leaf_to_host, tree_to_device
from newton_qd.qd.run.reevaluation import Reevaluated, corrected_fitnesses, reevaluate
from newton_qd.qd.run.same_task import changed_elites, require_same_task
from newton_qd.qd.scoring.checked import checked_scoring, why_empty
from newton_qd.qd.scoring.gradient_scores import finite_scores
from newton_qd.qd.scoring.networks import policy_for
from newton_qd.qd.scoring.robust import robust, run_scoring
from newton_qd.qd.scoring.rollout import episode_of, make_scoring_function
from newton_qd.qd.scoring.sharding import on_mesh, shard_scoring
from newton_qd.qd.scoring.task import Task
from newton_qd.types import PyTree, Repertoire, ScoringFunction

_KEYS = 4  # keys that follow from the seed of a run


class SearchError(RuntimeError):
    """The search cannot continue."""


@dataclasses.dataclass(frozen=True)
class SearchState:
    """An archive between two generations.

    Attributes:
        iteration: Generations that are finished; -1 before the initial population.
        repertoire: QDax's ``MapElitesRepertoire`` with flat genotypes.
        metrics: (iteration + 1, columns) one row per generation.
        emitter: State of QDax's emitter; ``None`` before the initial population.
        start: (N, size) genotypes of the initial population, the best first; ``None``:
            random ones.
    """

    iteration: int
    repertoire: Repertoire
    metrics: np.ndarray
    emitter: Any = None
    start: np.ndarray | None = None


class Search:
    """One algorithm of the MAP-Elites family on one task.

    Generation ``i`` draws its random numbers from a key folded with ``i``. So the state
    after it depends on the settings only.

    Attributes:
        options: Options of the algorithm, with the defaults of the environment.
    """

    def __init__(
        self, config: EvolveConfig, task: Task, mesh: Mesh | None = None
    ) -> None:
        """Builds the parts; compiles and evaluates nothing.

        Args:
            config: Settings with a grid or a number of centroids.
            task: Task to solve.
            mesh: Devices that share each evaluation. All else runs on the default
                device. ``None``: evaluations run on the default device too.

        Raises:
            MissingExtra: QDax is not installed.
            ConfigError: The algorithm or one of its options does not exist, or it
                does not run with these settings, or the episodes of ``task`` are
                shorter than ``config.episode_length``.
        """
        require_extra("qdax", "qd")
        check_length(task.env, config.episode_length, error=ConfigError)
        self._algorithm = _runnable(config)
        self.options = self._algorithm.read_options(config)
        self._config = config
        self._task = task
        self._mesh = mesh
        keys = _keys(config.seed)
        key_centroids, self._key_reset = keys[0], keys[1]
        self._key_initial, self._key_generations = keys[2], keys[3]
        self._key_reevaluations = jax.random.fold_in(self._key_reset, 1)
        self._policy = policy_for(task, config.hidden)
        self._centroids = cell_centroids(config, task.limits, key_centroids)
        with refused_options():
            score = self._scoring()
            parts = GenerationParts(
                self._algorithm, self.options, config, task, self._policy, score
            )
            self._drawn = Drawn(
                self._key_reset,
                jax.random.fold_in(self._key_generations, 0),
                self._centroids,
            )
            self._generation = parts.of(self._drawn)
        learns_on_mesh = self._algorithm.evaluates
        self._score = self._compiled(score)
        self._ask = jax.jit(parts.propose)
        self._enter = jax.jit(self._generation.enter)
        self._begin = self._compiled(parts.begin, learns_on_mesh)
        self._tell = self._compiled(parts.tell, learns_on_mesh)
        # one after the other if the network is the user's: on a CPU, two batches of QR
        # decompositions, as of orthogonal initializers, can wait for each other forever
        many = jax.vmap(self._initial)
        if task.network is not None:
            many = functools.partial(jax.lax.map, self._initial)
        self._population = jax.jit(many)

    def empty(self, start: np.ndarray | None = None) -> SearchState:
        """State before the initial population, which may be given (N, size)."""
        from qdax.core.containers.mapelites_repertoire import MapElitesRepertoire

        repertoire = MapElitesRepertoire.init_default(
            genotype=jnp.zeros((self._policy.size,), jnp.float32),
            centroids=self._centroids,
        )
        rows = np.zeros((0, len(COLUMNS)))
        return SearchState(-1, repertoire, rows, start=start)

    def advance(self, state: SearchState) -> SearchState:
        """Evaluates one generation and adds it to the archive.

        Raises:
            SearchError: No individual of the initial population has finite scores.
        """
        iteration = state.iteration + 1
        if iteration == 0:
            genotypes, repertoire, evaluations, rejected = self._settled(state)
            evaluations *= self._config.starts
            if self._algorithm.evaluates_first:
                size = self._config.batch_size * self._config.starts
                evaluations += self._episodes - size
            scores = self._score(genotypes, self._start(0))
            repertoire, emitter, metrics = self._begin(
                self._drawn, repertoire, genotypes, scores
            )
            metrics["rejected"] += rejected
        else:
            key = jax.random.fold_in(self._key_generations, iteration)
            genotypes, remembered = self._ask(
                self._drawn, state.repertoire, state.emitter, key
            )
            scores = self._score(genotypes, self._start(iteration))
            initial = np.float32(state.metrics[0][COLUMNS.index("initial_fitness")])
            repertoire, emitter, metrics = self._tell(
                self._drawn,
                state.repertoire,
                state.emitter,
                genotypes,
                remembered,
                scores,
                initial,
            )
            before = state.metrics[-1][COLUMNS.index("evaluations")]
            evaluations = int(before) + self._episodes
        row = {
            "iteration": iteration,
            "evaluations": evaluations,
            "env_steps": evaluations * self._config.episode_length,
            **{name: float(value) for name, value in metrics.items()},
        }
        if row["coverage"] == 0:
            # scores do not say why: the fitness is -inf for all reasons
            length = self._config.episode_length
            episode = episode_of(self._task, self._policy, length)
            found = jax.jit(jax.vmap(episode, (0, None)))(genotypes, self._key_reset)
            own = self._algorithm.name if self._algorithm.scoring else None
            raise SearchError(why_empty(found, own))
        rows = np.vstack([state.metrics, [row[name] for name in COLUMNS]])
        return SearchState(iteration, repertoire, rows, emitter)

    def _settled(self, state: SearchState) -> tuple[jax.Array, Repertoire, int, int]:
        """Prepares the initial population.

        A generation has a fixed size. The best of the given genotypes become the
        initial population, which random ones complete. The others enter the archive
        before it, so that the emitter begins with the whole archive.

        Returns:
            Genotypes (batch_size, size) of the initial population, the archive with the
            others, the number of individuals in total, and how many of the others have
            no finite scores.
        """
        size = self._config.batch_size
        keys = jax.random.split(self._key_initial, size)
        population, repertoire = self._population(keys), state.repertoire
        if state.start is None:
            return population, repertoire, size, 0
        start, rejected = state.start, 0
        for begin in range(size, len(start), size):
            rows = np.minimum(np.arange(begin, begin + size), len(start) - 1)
            some = jnp.asarray(start[rows])
            scores = self._score(some, self._start(0))
            repertoire = self._enter(repertoire, some, scores)
            rejected += int(jnp.sum(~finite_scores(*scores[:2])[: len(start) - begin]))
        best = start[:size]
        population = population.at[: len(best)].set(jnp.asarray(best))
        return population, repertoire, max(size, len(start)), rejected

    def _start(self, iteration: int) -> jax.Array:
        """Returns the key of the start states of a generation."""
        if not self._config.new_starts:
            return self._key_reset
        # 0 is the key of the first population, and 1 that of the re-evaluations
        return jax.random.fold_in(self._key_reset, iteration + 2)

    @functools.cached_property
    def _episodes(self) -> int:
        """Episodes of one generation."""
        spec = self._algorithm
        episodes = spec.evaluations(self._config, self.options)
        alone = 0
        count = spec.from_one_start or spec.gradients
        if count is not None and spec.scoring is None:
            # gradients of an emitter follow one episode
            alone = count(self._config, self.options)
        return (episodes - alone) * self._config.starts + alone

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
            emitter=tuple(leaf_to_host(x) for x in jax.tree.leaves(state.emitter)),
        )

    def reevaluate(
        self,
        archive: Archive,
        stop: Callable[[], bool] = lambda: False,
        *,
        untrained: float | None = None,
    ) -> Reevaluated | None:
        """Evaluates the elites again; ``None`` if the settings do not ask for it."""
        if not self._config.reevaluations:
            return None
        return reevaluate(
            archive,
            self._again,
            self._key_reevaluations,
            reevaluations=self._config.reevaluations,
            offset=self._generation.offset,
            untrained=untrained,
            stop=stop,
        )

    def corrected(self, archive: Archive) -> np.ndarray:
        """Returns the fitness (cells,) of each cell after another evaluation."""
        if not self._config.reevaluations:
            return archive.fitnesses
        found = corrected_fitnesses(
            archive, self._again, self._key_reevaluations, self._config.reevaluations
        )
        assert found is not None  # nothing stops it
        return found

    @functools.cached_property
    def _again(self) -> Callable[..., Any]:
        """The compiled scoring function of one start state."""
        length = self._config.episode_length
        score = make_scoring_function(self._task, self._policy, length)
        return self._compiled(self._split(score))

    def restore(self, checkpoint: Checkpoint) -> SearchState:
        """Makes the state of a checkpoint.

        Raises:
            CheckpointError: Its arrays do not fit this version of the algorithm.
            ConfigError: It is of another task.
        """
        limits, size = self._task.limits, self._policy.size
        require_same_task("checkpoint", checkpoint, self._config, limits, size)
        return SearchState(
            checkpoint.iteration,
            repertoire_of(checkpoint),
            complete_metrics(checkpoint.metrics),
            self._restore_emitter(checkpoint.emitter),
        )

    def changed(self, checkpoint: Checkpoint) -> tuple[int, int]:
        """Returns how many elites have other scores now, of how many evaluated ones."""
        if self._config.new_starts:  # the start states of an elite are not known
            return 0, 0
        return changed_elites(
            checkpoint,
            lambda genotypes: self._score(genotypes, self._key_reset)[:2],
            self._config.batch_size,
        )

    def _restore_emitter(self, leaves: tuple[np.ndarray, ...]) -> PyTree:
        """Makes the emitter's state from the leaves of a checkpoint.

        Raises:
            CheckpointError: The leaves do not fit this algorithm.
        """
        shape = (self._config.batch_size, self._policy.size)
        genotypes = jax.ShapeDtypeStruct(shape, jnp.float32)
        score = self._scoring()
        scores = jax.eval_shape(score, genotypes, self._key_reset)
        repertoire = self.empty().repertoire
        example = jax.eval_shape(self._generation.begin, repertoire, genotypes, scores)[
            1
        ]
        return tree_to_device(leaves, example, self._config.algorithm)

    def _initial(self, key: jax.Array) -> jax.Array:
        """Returns weights (size,) of an individual of the initial population."""
        scale = self._algorithm.initial_scale(self.options)
        return scale * self._policy.init(key)

    def _scoring(self) -> ScoringFunction:
        """Returns the scoring function of the loop, split over the mesh."""
        if self._algorithm.scoring is None:
            return self._split(
                run_scoring(
                    self._config,
                    self._task,
                    self._policy,
                    transitions=self._algorithm.transitions,
                )
            )
        score = self._algorithm.scoring(
            self._config, self.options, self._task, self._policy
        )
        name, measures = self._algorithm.name, self._task.descriptor_length
        score = checked_scoring(score, name, measures)
        return self._split(robust(score, self._config, self._task))

    def _split(self, score: ScoringFunction) -> ScoringFunction:
        return score if self._mesh is None else shard_scoring(score, self._mesh)

    def _compiled(self, function: Callable[..., Any], evaluates: bool = True) -> PyTree:
        """Compiles a function, for all devices of the mesh if it evaluates."""
        if self._mesh is None or not evaluates:
            return jax.jit(function)
        return on_mesh(function, self._mesh)


def start_key(seed: int) -> jax.Array:
    """Returns the key of a run's resets; ``new_starts`` folds a number into it."""
    return _keys(seed)[1]


def other_start_keys(seed: int, count: int) -> jax.Array:
    """Returns (count,) keys of resets that no run has trained with.

    Args:
        seed: The seed, which may be that of the run.
        count: Number of keys.
    """
    # without the fold, the second key would be that of the resets of a run
    return jax.random.split(jax.random.fold_in(jax.random.key(seed), _KEYS), count)


def _keys(seed: int) -> jax.Array:
    """Returns keys of centroids, start state, initial population and generations."""
    return jax.random.split(jax.random.key(seed), _KEYS)


def _runnable(config: EvolveConfig) -> AlgorithmSpec[Any]:
    """Returns the algorithm of a run.

    Raises:
        ConfigError: It does not exist, or it cannot run with these settings.
    """
    spec = algorithm_named(config.algorithm)
    if config.batch_size < spec.smallest:
        allowed = f"at least {spec.smallest} for {config.algorithm!r}"
        raise ConfigError(message("batch_size", config.batch_size, allowed))
    if jax.config.read("jax_enable_x64") and not spec.double:
        why = "which is QDax's and mixes precisions in JAX's 64-bit mode"
        allowed = "those of newton_qd, or any without jax_enable_x64"
        raise ConfigError(message("algorithm", config.algorithm, allowed, why=why))
    return spec
