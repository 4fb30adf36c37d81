"""A run that can be opened: its settings, its elites, and their evaluation."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.envs.base import Env
from newton_qd.envs.inputs import require_key
from newton_qd.errors import require_extra
from newton_qd.gradients.episode_input import check_length
from newton_qd.qd.algorithms import algorithm_named
from newton_qd.qd.config import EvolveConfig, read_config
from newton_qd.qd.run.archive import Archive, repertoire_of
from newton_qd.qd.run.evaluation import Evaluation, Evaluator
from newton_qd.qd.run.folder import CONFIG, REEVALUATED
from newton_qd.qd.run.plot_grid import grid_indices
from newton_qd.qd.run.progress import results_text
from newton_qd.qd.run.reevaluation import Reevaluated
from newton_qd.qd.run.results import read_reevaluated, read_results
from newton_qd.qd.run.same_task import require_same_task
from newton_qd.qd.run.search import start_key
from newton_qd.qd.scoring.networks import policy_for
from newton_qd.qd.scoring.rollout import Policy
from newton_qd.qd.scoring.task import Task, made_task, make_task, randomized
from newton_qd.real_numbers import real_numbers
from newton_qd.types import Environment, Repertoire, RNGKey
from newton_qd.wrappers.one_world import require_one_world

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


@dataclasses.dataclass(frozen=True, eq=False)
class Run:
    """The results folder of a run, opened.

    It pickles, for other processes, if the network of a policy of your own does.

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

    def __getstate__(self) -> dict[str, Any]:
        """Returns what pickle stores: no compiled functions."""
        fields = dataclasses.fields(self)
        return {field.name: getattr(self, field.name) for field in fields}

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
            fitnesses, found = self._evaluator.as_in_run(genotypes)
        else:
            fitnesses, found = self._evaluator.from_keys(genotypes, keys)
        if alone:
            return Evaluation(rows[0], fitnesses[0], found[0])
        return Evaluation(rows, fitnesses, found)

    def with_env(self, env: Environment) -> Run:
        """Returns the same run with another environment, such as a damaged robot.

        Its elites keep their fitnesses and descriptors in the archive. ``evaluate`` and
        ``record_elites`` use the new environment.

        Args:
            env: Environment of one world without auto-reset, with as many observations
                and actions.

        Raises:
            TypeError: ``env`` is no environment.
            ValueError: It has a batch, auto-reset or other sizes, or its episodes are
                shorter than those of the run.
        """
        checks.environment(env)
        if isinstance(env, Env):
            require_one_world(env)
        check_length(env, self.config.episode_length)
        new, own = (_sizes(one) for one in (env, self.task.env))
        if new != own:
            raise ValueError(message("env", Fact(new), own))
        return dataclasses.replace(self, task=dataclasses.replace(self.task, env=env))

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

    @functools.cached_property
    def _evaluator(self) -> Evaluator:
        return Evaluator(self.config, self.task, self.policy, self.start_key)

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


def _sizes(env: Environment) -> str:
    """Returns what a policy must fit, as text."""
    sizes = f"{env.observation_size} observations and {env.action_size} actions"
    return f"an environment with {sizes}"


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
