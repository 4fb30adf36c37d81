"""The results folder of a run: its files and its lock.

``config.json`` (settings), ``checkpoint.bin`` (state to resume from),
``metrics.csv`` (one row per generation), ``archive.npz``, ``archive.png`` and
``corrected.json`` (metrics of the finished run, from re-evaluated elites).
``start.npz`` has the genotypes that the run started from, if they were given.
``tensorboard`` has event files, if the run writes them.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.files import temporary_files, write_atomically
from newton_qd.qd.algorithms import algorithm_named
from newton_qd.qd.config import (
    ConfigError,
    EvolveConfig,
    config_to_json,
    read_config,
    same_run,
    settings_text,
)
from newton_qd.qd.facts import changed_facts
from newton_qd.qd.run.archive import ARCHIVE, Archive, archive_bytes
from newton_qd.qd.run.checkpoint import (
    DAMAGE,
    Checkpoint,
    CheckpointError,
    load_checkpoint,
    npz_bytes,
    read_npz,
    save_checkpoint,
)

CONFIG = "config.json"
CHECKPOINT = "checkpoint.bin"
METRICS = "metrics.csv"
PICTURE = "archive.png"
REEVALUATED = "corrected.json"  # a name that earlier versions know
START = "start.npz"
EVENTS = "tensorboard"
_OWN_FILES = (CONFIG, CHECKPOINT, METRICS, ARCHIVE, REEVALUATED, START)
_FILES = (*_OWN_FILES, PICTURE)  # newton-qd plot writes the picture, too

COLUMNS = (
    "iteration",
    "evaluations",
    "env_steps",
    "rejected",
    "qd_score",
    "coverage",
    "max_fitness",
    "mean_fitness",
    "initial_fitness",
    "qd_gain",
)
_WHOLE_COLUMNS = 4
_FIRST_COLUMNS = 7  # of runs before the last three columns


class RunFolder:
    """A results folder that one process writes to.

    Attributes:
        path: The folder.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Stores the path of the folder; does not create it.

        Args:
            path: Folder. It does not have to exist yet.

        Raises:
            ConfigError: ``path`` is no path.
        """
        kinds = (str, os.PathLike)
        checks.instance("out", path, kinds, "a folder", error=ConfigError)
        self.path = Path(path)

    @property
    def has_config(self) -> bool:
        """Whether a run was started here."""
        return (self.path / CONFIG).is_file()

    def check(self, *, resume: bool) -> None:
        """Checks that the folder is empty, or has a run to resume.

        Args:
            resume: Whether to continue an earlier run.

        Raises:
            ConfigError: The folder is not empty, or has no run to resume.
        """
        if self.path.exists() and not self.path.is_dir():
            raise self._refused("which is a file", "a folder")
        if not self._occupied():
            return
        if not self.has_config:
            why = f"which is not empty and has no {CONFIG}"
            allowed = "an empty or another folder"
            if resume:
                allowed += ", or a folder that holds a run to resume"
            raise self._refused(why, allowed)
        if not resume:
            allowed = (
                "an empty or another folder; add --resume to continue the run in it"
            )
            raise self._refused("which is not empty", allowed)

    def _refused(self, why: str, allowed: str) -> ConfigError:
        return ConfigError(message("out", Fact(self.path), allowed, why=why))

    def _occupied(self) -> bool:
        """Whether the folder has other files than unfinished files of a killed run."""
        if not self.path.exists():
            return False
        ignored = {part.name for part in self._unfinished(*_FILES)}
        if not self.has_config:  # killed between this file and the settings
            ignored.add(START)
        return any(entry.name not in ignored for entry in self.path.iterdir())

    def _unfinished(self, *names: str) -> list[Path]:
        """Returns the unfinished files of a killed run."""
        return [part for name in names for part in temporary_files(self.path / name)]

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Creates the folder and keeps other processes from writing to it.

        Raises:
            ConfigError: The folder cannot be created, or another run writes to it.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            why = f"and cannot create it: {error.strerror}"
            raise self._refused(why, "a folder that can be made") from error
        try:
            import fcntl
        except ImportError:  # Windows: the user must avoid a second writer
            yield
            return
        # The kernel releases this lock when the process ends for any reason.
        descriptor = os.open(self.path, os.O_RDONLY)
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                why = "and another process is writing to it"
                raise self._refused(why, "a folder for each run") from error
            for part in self._unfinished(*_OWN_FILES):
                part.unlink(missing_ok=True)
            yield
        finally:
            os.close(descriptor)

    def start(
        self,
        config: EvolveConfig,
        facts: dict[str, object],
        genotypes: np.ndarray | None = None,
    ) -> None:
        """Writes the settings of a new run, and the genotypes that it starts from."""
        if genotypes is not None:
            write_atomically(self.path / START, npz_bytes(genotypes=genotypes))
        content = config_to_json(config, facts)
        write_atomically(self.path / CONFIG, content.encode())

    def start_genotypes(self) -> np.ndarray | None:
        """Returns the genotypes (N, size) that the run started from, if it has any.

        Raises:
            CheckpointError: The file is damaged.
        """
        path = self.path / START
        if not path.is_file():
            return None
        content = path.read_bytes()
        try:
            return read_npz(content)["genotypes"]
        except DAMAGE as error:
            raise CheckpointError(f"{path} is damaged: {error}") from error

    def compare(self, config: EvolveConfig) -> tuple[EvolveConfig, dict[str, object]]:
        """Checks that settings are those of the run here, or other generations.

        There may be more of them, or fewer if the run has not made them yet.

        Returns:
            The settings of the run, and the facts of the machine that began it.

        Raises:
            CheckpointError: The checkpoint is damaged.
            ConfigError: A setting differs from the run's, or its algorithm does not go
                on beyond the end of a run.
        """
        stored, facts = read_config(self.path / CONFIG)
        goes_on = algorithm_named(config.algorithm).goes_on
        for name, old, new in stored.differences(config):
            if name == "warm_start":
                begun = "no archive" if old is None else f"that with SHA-256 {old}"
                given = "nothing" if new is None else f"genotypes with SHA-256 {new}"
                raise self._other_run("start_from", begun, Fact(given))
            if name != "iterations":
                raise self._other_run(name, repr(old), new)
            if config.iterations < stored.iterations:
                least = self._reached() if goes_on else stored.iterations
                if config.iterations < least:
                    more = " or more" if goes_on else ""
                    raise self._other_run(name, f"{least!r}{more}", new)
            if not goes_on:
                why = f"but {config.algorithm!r} cannot go on beyond the end of a run"
                raise self._other_run(name, repr(old), new, why)
        return stored, facts

    def _reached(self) -> int:
        """Returns how many generations the run here has made and saved.

        Raises:
            CheckpointError: The checkpoint is damaged.
        """
        path = self.path / CHECKPOINT
        return self._checkpoint(path).iteration if path.exists() else 0

    def compare_environment(self, env_name: str) -> None:
        """Checks that the run here, if there is one, is of this environment.

        All other settings depend on it, so their errors would mislead.

        Raises:
            ConfigError: It is of another environment.
        """
        if self.has_config:
            stored, _ = read_config(self.path / CONFIG)
            if stored.env_name != env_name:
                raise self._other_run("env_name", repr(stored.env_name), env_name)

    def _other_run(
        self, name: str, old: str, new: object, why: str = ""
    ) -> ConfigError:
        allowed = f"{old}, as the run in {self.path} has; or start a new run in "
        return ConfigError(message(name, new, f"{allowed}another folder", why=why))

    def restore(
        self, config: EvolveConfig, facts: dict[str, object]
    ) -> tuple[Checkpoint | None, list[str]]:
        """Reads the state of a run that was stopped, or that goes on beyond its end.

        It changes no file; see ``go_on``.

        Args:
            config: Settings that the run is expected to have. It may have other
                generations, if the run has not made more.
            facts: Facts of this machine.

        Returns:
            The checkpoint (``None`` if the run was stopped before the first) and
            warnings about a machine that differs.

        Raises:
            ConfigError: A setting differs from the run's.
            CheckpointError: The checkpoint is damaged, belongs to another run, or
                was deleted after the archive was written.
        """
        _, old_facts = self.compare(config)
        warnings = []
        for name, old, new in changed_facts(old_facts, facts):
            if name == "x64":
                allowed = f"{old!r}, as the run in {self.path} has"
                raise ConfigError(message("jax_enable_x64", new, allowed))
            warnings.append(
                f"warning: {name} was {old} when the run began and is {new} now; "
                "the result may differ from an uninterrupted run"
            )
        path = self.path / CHECKPOINT
        if path.exists():
            checkpoint = self._checkpoint(path)
            require_same_run(path, checkpoint, config)
            return checkpoint, warnings
        if (self.path / ARCHIVE).exists():
            raise CheckpointError(
                f"{path} is missing, so the run cannot go on; delete {ARCHIVE}, the "
                "result so far, to start it again"
            )
        return None, warnings

    def _checkpoint(self, path: Path) -> Checkpoint:
        """Reads the checkpoint of a run that goes on.

        Raises:
            CheckpointError: It is damaged.
        """
        try:
            return load_checkpoint(path)
        except CheckpointError as error:
            cure = f"to start the run again, delete it and {ARCHIVE}"
            raise CheckpointError(f"{error}; {cure}") from error

    def go_on(self, config: EvolveConfig, *, anew: bool = False) -> None:
        """Writes the settings of a run that goes on beyond its end.

        Args:
            config: Settings with which the checkpoint was restored.
            anew: Whether there was no checkpoint, so the run starts again.

        Raises:
            ConfigError: A setting other than the number of generations differs.
        """
        stored, facts = self.compare(config)
        if anew or stored != config:
            (self.path / REEVALUATED).unlink(missing_ok=True)  # of the earlier end
        if anew:
            (self.path / METRICS).unlink(missing_ok=True)
        if stored != config:
            self.start(config, facts)

    def save(self, checkpoint: Checkpoint) -> None:
        """Writes the checkpoint, then the metrics up to it."""
        save_checkpoint(self.path / CHECKPOINT, checkpoint)
        text = metrics_to_csv(checkpoint.metrics)
        write_atomically(self.path / METRICS, text.encode())

    def save_archive(self, archive: Archive, picture: bytes) -> None:
        """Writes the archive and its picture."""
        write_atomically(self.path / ARCHIVE, archive_bytes(archive))
        write_atomically(self.path / PICTURE, picture)

    def save_reevaluated(self, metrics: dict[str, float]) -> None:
        """Writes the metrics of re-evaluated elites."""
        text = json.dumps(metrics, indent=2) + "\n"
        write_atomically(self.path / REEVALUATED, text.encode())


def require_same_run(path: Path, state: Checkpoint, config: EvolveConfig) -> None:
    """Checks that a checkpoint is of a run with some settings.

    Args:
        path: The checkpoint, for the error.
        state: Its content.
        config: The settings.

    Raises:
        CheckpointError: It belongs to another run.
    """
    if not same_run(state.settings, settings_text(config)):
        raise CheckpointError(
            f"{path} belongs to a run with other settings than {CONFIG}"
        )


def complete_metrics(metrics: np.ndarray) -> np.ndarray:
    """Returns metrics with all columns; those that an earlier version lacked are NaN.

    Args:
        metrics: (rows, columns) metrics of this or an earlier version.

    Raises:
        ValueError: The number of columns is not that of any version.
    """
    rows, columns = metrics.shape
    if columns not in (_FIRST_COLUMNS, len(COLUMNS)):
        allowed = f"{_FIRST_COLUMNS}, {len(COLUMNS)}"
        raise ValueError(message("columns of metrics", columns, allowed))
    missing = np.full((rows, len(COLUMNS) - columns), np.nan)
    return np.hstack([metrics, missing])


def metrics_to_csv(metrics: np.ndarray) -> str:
    """Formats metrics.

    Args:
        metrics: (rows, columns) in the order of ``COLUMNS``.
    """
    lines = [",".join(COLUMNS)]
    for row in metrics:
        whole = [str(int(value)) for value in row[:_WHOLE_COLUMNS]]
        # The metrics are single precision: more digits have no meaning.
        rest = [str(np.float32(value)) for value in row[_WHOLE_COLUMNS:]]
        lines.append(",".join(whole + rest))
    return "\n".join(lines) + "\n"
