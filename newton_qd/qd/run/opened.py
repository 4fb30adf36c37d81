"""A run that can be opened: its settings, its elites, and their evaluation."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.envs.inputs import require_key
from newton_qd.errors import require_extra
from newton_qd.qd.algorithms import ALGORITHMS, algorithm_named
from newton_qd.qd.config import EvolveConfig, read_config
from newton_qd.qd.run.archive import Archive, repertoire_of
from newton_qd.qd.run.folder import CONFIG, REEVALUATED
from newton_qd.qd.run.plot_grid import grid_indices
from newton_qd.qd.run.progress import results_text
from newton_qd.qd.run.reevaluation import Reevaluated
from newton_qd.qd.run.results import read_reevaluated, read_results
from newton_qd.qd.run.same_task import require_same_task
from newton_qd.qd.run.search import start_key
from newton_qd.qd.scoring.networks import policy_for
from newton_qd.qd.scoring.robust import robust, run_scoring
from newton_qd.qd.scoring.rollout import Policy, episode_of
from newton_qd.qd.scoring.task import Task, made_task, make_task, randomized
from newton_qd.real_numbers import real_numbers
from newton_qd.types import Repertoire, RNGKey, ScoringFunction

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclasses.dataclass(frozen=True)
class Elite:
    """An individual of an archive.

    Attributes:
        cell: Its row in the archive.
        genotype: (size,) policy weights.
        fitness: Fitness in the archive.
        descriptor: (D,) descriptor in the archive.
    """

    cell: int
    genotype: np.ndarray
    fitness: float
    descriptor: np.ndarray


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


@dataclasses.dataclass(frozen=True, eq=False)
class Run:
    """The results folder of a run, opened.

    Attributes:
        path: The folder.
        config: Settings with a grid or a number of centroids.
        facts: Facts of the machine that made the run: versions, backend.
        task: Environment, descriptor, limits and labels.
        policy: Policy whose weights are the genotypes.
        archive: The elites as NumPy arrays, one row per cell.
        metrics: Name of each column of ``metrics.csv`` to its values
            (iteration + 1,).
        reevaluated: Metrics of re-evaluated elites; ``None`` if there are none.
        start_key: Key of the reset that all evaluations of the run start with. It
            follows from the seed. With ``new_starts``, generations have other keys.
            Several start states have the keys ``jax.random.split(start_key, starts)``.
    """

    path: Path
    config: EvolveConfig
    facts: dict[str, object]
    task: Task
    policy: Policy
    archive: Archive
    metrics: dict[str, np.ndarray]
    reevaluated: Reevaluated | None
    start_key: RNGKey

    def __repr__(self) -> str:
        return f"<Run {self.path}: {results_text(self.config, self.metrics)}>"

    @property
    def iteration(self) -> int:
        """Generations that are finished."""
        return len(self.metrics["iteration"]) - 1

    @functools.cached_property
    def repertoire(self) -> Repertoire:
        """The archive as ``MapElitesRepertoire`` of QDax."""
        return repertoire_of(self.archive)

    @property
    def cells(self) -> np.ndarray:
        """(N,) cells that hold an elite, in the order of the archive."""
        return np.flatnonzero(self.archive.filled)

    def elite(self, cell: int | Sequence[int]) -> Elite:
        """Returns the elite of a cell.

        Args:
            cell: Row of the archive, or for a grid the indices along each dimension.

        Raises:
            IndexError: The cell does not exist.
            LookupError: The cell is empty.
        """
        row = self._row(cell)
        archive = self.archive
        if not archive.filled[row]:
            why = "which is empty"
            count = f"one of the {archive.filled.sum()} cells in run.cells"
            raise LookupError(message("cell", cell, count, why=why))
        return Elite(
            row,
            archive.genotypes[row],
            float(archive.fitnesses[row]),
            archive.descriptors[row],
        )

    def best(self, count: int = 1) -> list[Elite]:
        """Returns the fittest elites, the best first.

        Raises:
            ValueError: ``count`` is not an integer from 1.
        """
        checks.integer("count", count)
        cells = self.cells
        order = np.argsort(-self.archive.fitnesses[cells], kind="stable")
        return [self.elite(int(cell)) for cell in cells[order][:count]]

    def nearest(
        self, descriptor: Sequence[float] | np.ndarray, count: int = 1
    ) -> list[Elite]:
        """Returns the elites whose descriptors are nearest, the nearest first.

        Args:
            descriptor: (D,) wanted descriptor.
            count: Number of elites.

        Raises:
            ValueError: ``descriptor`` has another length, is not finite, or ``count``
                is not an integer from 1.
        """
        checks.integer("count", count)
        length = self.task.descriptor_length
        wanted = real_numbers(descriptor)
        if wanted is None or wanted.shape != (length,) or not np.isfinite(wanted).all():
            numbers = "1 finite number" if length == 1 else f"{length} finite numbers"
            allowed = f"{numbers}: {', '.join(self.task.labels)}"
            raise ValueError(message("descriptor", descriptor, allowed))
        low, high = self.task.limits
        cells = self.cells
        # in units of the limits, so that no component counts more than another
        gaps = (self.archive.descriptors[cells] - wanted) / (high - low)
        order = np.argsort(np.linalg.norm(gaps, axis=1), kind="stable")
        return [self.elite(int(cell)) for cell in cells[order][:count]]

    def evaluate(
        self,
        cell: int | Sequence[int] | np.ndarray | None = None,
        keys: RNGKey | None = None,
    ) -> Evaluation:
        """Evaluates elites again.

        Args:
            cell: Row of the archive, or a list or array of (N,) rows; ``None``: all
                elites. A tuple is one cell of a grid: its indices along each dimension.
            keys: Key or (K,) keys of the reset. ``None``: the key of the run. Then
                fitness and descriptor are bitwise those of the archive, on the same
                kind of machine with the same versions. With ``new_starts`` they are
                not, because each generation had start states of its own.

        Raises:
            IndexError: A cell does not exist.
            LookupError: A cell is empty, or there is none.
            TypeError: ``keys`` are no keys.
            ValueError: ``keys`` are none at all, or ``cell`` has more axes than one.
        """
        if keys is not None:
            require_key("keys", keys, several=True)
            if keys.size == 0:
                raise ValueError(message("keys", Fact("no keys"), "one or more"))
        rows, alone = self._rows(cell)
        genotypes = np.stack([self.elite(row).genotype for row in rows.tolist()])
        if keys is None:
            fitnesses, found = self._chunks(self._score, genotypes)
        else:
            fitnesses, found = self._from_keys(genotypes, keys)
        if alone:
            return Evaluation(rows[0], fitnesses[0], found[0])
        return Evaluation(rows, fitnesses, found)

    def plot(self) -> Figure:
        """Draws the archive.

        Raises:
            MissingExtra: matplotlib is not installed.
        """
        from newton_qd.qd.run.plot import archive_figure

        return archive_figure(self.archive, self.config, self.task, self.iteration)

    def plot_curves(self) -> Figure:
        """Draws QD score, coverage and best fitness over the evaluations.

        Raises:
            MissingExtra: matplotlib is not installed.
        """
        from newton_qd.qd.run.plot_curves import curves_figure

        return curves_figure(self.metrics, self.config, self.reevaluated)

    def _rows(
        self, cell: int | Sequence[int] | np.ndarray | None
    ) -> tuple[np.ndarray, bool]:
        """Returns rows (N,) of the archive, and whether ``cell`` was a single one.

        Raises:
            IndexError: A cell of the grid does not exist.
            LookupError: There are none, or a cell of the grid is empty.
            ValueError: ``cell`` has more axes than one.
        """
        if isinstance(cell, tuple):
            cell = self.elite(cell).cell
        rows = self.cells if cell is None else np.asarray(cell)
        if rows.ndim > 1:
            allowed = "a row, rows (N,), or a tuple with the indices of one cell"
            raise ValueError(message("cell", cell, allowed))
        if not rows.size:
            allowed = "at least one; without cell, an archive with elites"
            raise LookupError(message("cell", cell, allowed, why="which names none"))
        return np.atleast_1d(rows), rows.ndim == 0

    def _row(self, cell: int | Sequence[int]) -> int:
        """Returns the row of a cell.

        Raises:
            IndexError: The cell does not exist.
        """
        count, grid = len(self.archive.centroids), self.config.grid
        if isinstance(cell, Sequence) and grid is not None and cell != str(cell):
            table = grid_indices(self.archive.centroids, grid, self.task.limits)
            if len(cell) == len(grid) and all(map(checks.is_integer, cell)):
                rows = np.flatnonzero((table == np.asarray(cell)).all(axis=1))
                if len(rows) == 1:
                    return int(rows[0])
            cells = "x".join(map(str, grid))
            allowed = f"indices of a grid of {cells} cells"
            raise IndexError(message("cell", cell, allowed))
        if not (checks.is_integer(cell) and 0 <= cell < count):
            raise IndexError(message("cell", cell, f"integers from 0 to {count - 1}"))
        return int(cell)

    @functools.cached_property
    def _score(self) -> Callable[[jax.Array, jax.Array], tuple]:
        """The scoring function of the loop, compiled: genotypes and their keys."""
        score = jax.jit(self._loop_scoring())
        return lambda genotypes, _: score(genotypes, self.start_key)[:2]

    def _loop_scoring(self) -> ScoringFunction:
        """Returns the scoring function of the loop, without gradients.

        Those of the package have the same values with gradients; a registered
        algorithm may score differently.
        """
        config, spec = self.config, algorithm_named(self.config.algorithm)
        if spec in ALGORITHMS or spec.scoring is None:
            return run_scoring(config, self.task, self.policy)
        options = spec.read_options(config)
        score = spec.scoring(config, options, self.task, self.policy)
        return robust(score, config, self.task)

    @functools.cached_property
    def _pairs(self) -> Callable[[jax.Array, jax.Array], tuple]:
        """Evaluates genotypes (N, size), each from its own key (N,)."""
        episode = episode_of(self.task, self.policy, self.config.episode_length)

        def pairs(genotypes: jax.Array, keys: jax.Array) -> tuple:
            found = jax.vmap(episode)(genotypes, keys)
            return found.fitness, found.descriptor

        return jax.jit(pairs)

    def _from_keys(
        self, genotypes: np.ndarray, keys: RNGKey
    ) -> tuple[np.ndarray, np.ndarray]:
        """Evaluates each genotype from each key."""
        # keys of the old kind are integers (2,)
        old = not jnp.issubdtype(keys.dtype, jax.dtypes.prng_key)
        shape = keys.shape[:-1] if old else keys.shape
        flat = keys.reshape((-1, keys.shape[-1]) if old else (-1,))
        fitnesses, found = self._chunks(
            self._pairs,
            np.repeat(genotypes, len(flat), axis=0),
            jnp.tile(flat, (len(genotypes), 1) if old else len(genotypes)),
        )
        leading = (len(genotypes), *shape)
        return fitnesses.reshape(leading), found.reshape(*leading, -1)

    def _chunks(
        self,
        evaluate: Callable[[jax.Array, jax.Array], tuple],
        genotypes: np.ndarray,
        keys: jax.Array | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Evaluates in batches of the size of a generation.

        One size is compiled once. It is the size of the run, because sums of a policy
        could depend on it.
        """
        size, count = self.config.batch_size, len(genotypes)
        fitnesses, descriptors = [], []
        for begin in range(0, count, size):
            rows = np.minimum(np.arange(begin, begin + size), count - 1)
            some = self.start_key if keys is None else keys[rows]
            fitness, descriptor = evaluate(jnp.asarray(genotypes[rows]), some)
            fitnesses.append(np.asarray(fitness))
            descriptors.append(np.asarray(descriptor))
        return np.concatenate(fitnesses)[:count], np.concatenate(descriptors)[:count]


def load_run(
    folder: str | os.PathLike[str],
    *,
    task_factory: Callable[[EvolveConfig], Task] = make_task,
) -> Run:
    """Opens the results folder of a run.

    A run that still goes on, or was killed, can be opened after its first checkpoint.

    Args:
        folder: Results folder of ``evolve``.
        task_factory: Makes the task; by default from registered environments.

    Raises:
        ConfigError: The folder holds no run, or its settings do not fit the task.
        ArchiveError: ``archive.npz`` is damaged, and there is no checkpoint.
        CheckpointError: The checkpoint belongs to a run with other settings, or is
            damaged, and there is no ``archive.npz``.
        FileNotFoundError: The run was stopped before its first checkpoint.
        MissingExtra: QDax is not installed.
        TypeError: ``folder`` is no path.
        UnknownEnvironment: The environment of the run is not registered.
    """
    checks.instance("folder", folder, (str, os.PathLike), "a results folder of evolve")
    require_extra("qdax", "qd")
    path = Path(folder)
    config, facts = read_config(path / CONFIG)
    algorithm_named(config.algorithm)
    archive, metrics = read_results(path, config)
    task = randomized(config, made_task(task_factory, config))
    config = config.resolve(task.descriptor_length)
    policy = policy_for(task, config.hidden)
    require_same_task(str(path), archive, config, task.limits, policy.size)
    return Run(
        path=path,
        config=config,
        facts=facts,
        task=task,
        policy=policy,
        archive=archive,
        metrics=metrics,
        reevaluated=read_reevaluated(path / REEVALUATED),
        start_key=start_key(config.seed),
    )
