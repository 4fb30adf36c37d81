"""The files of a results folder, read: archive, metrics, re-evaluated elites."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
from pathlib import Path

import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.errors import warn
from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.run.archive import ARCHIVE, Archive, archive_of, load_archive
from newton_qd.qd.run.checkpoint import Checkpoint, CheckpointError, load_checkpoint
from newton_qd.qd.run.folder import (
    CHECKPOINT,
    COLUMNS,
    METRICS,
    complete_metrics,
    require_same_run,
)
from newton_qd.qd.run.reevaluation import Reevaluated


def read_results(
    folder: str | os.PathLike[str], config: EvolveConfig | None = None
) -> tuple[Archive, dict[str, np.ndarray]]:
    """Returns archive and metrics of a results folder, from the newest files.

    Args:
        folder: The folder.
        config: Settings of the run, if they matter.

    Raises:
        ArchiveError: ``archive.npz`` is damaged, and there is no checkpoint.
        CheckpointError: The checkpoint belongs to a run with other settings, or is
            damaged, and there is no ``archive.npz``.
        FileNotFoundError: The run was stopped before its first checkpoint.
    """
    path = Path(folder)
    state = _newest(path)
    if state is None:
        archive = load_archive(path)
        return archive, _metrics_of(archive, _metrics(path / METRICS))
    if config is not None:
        require_same_run(path / CHECKPOINT, state, config)
    columns = complete_metrics(np.asarray(state.metrics)).T
    return archive_of(state), dict(zip(COLUMNS, columns, strict=True))


def read_archive(folder: str | os.PathLike[str]) -> Archive:
    """Returns the archive of a results folder, from the newest file.

    Raises:
        ArchiveError: ``archive.npz`` is damaged, and there is no checkpoint.
        CheckpointError: The checkpoint is damaged, and there is no ``archive.npz``.
        FileNotFoundError: The run was stopped before its first checkpoint.
    """
    path = Path(folder)
    state = _newest(path)
    return load_archive(path) if state is None else archive_of(state)


def _newest(path: Path) -> Checkpoint | None:
    """Returns the checkpoint, which is never older than the archive.

    Returns:
        The checkpoint; ``None`` if there is none, or, with a warning, if it is damaged
        and there is an archive.

    Raises:
        CheckpointError: It is damaged, and there is no ``archive.npz``.
    """
    if not (path / CHECKPOINT).is_file():
        return None
    try:
        return load_checkpoint(path / CHECKPOINT)
    except CheckpointError as error:
        if not (path / ARCHIVE).is_file():
            raise
        text = f"{error}; its archive is read from {ARCHIVE} instead, and its metrics "
        text += f"up to that archive from {METRICS}"
        warn(text)
        return None


def _metrics_of(
    archive: Archive, metrics: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Returns metrics up to the generation of an archive.

    A run that went on and was killed has an archive of its earlier end, but metrics up
    to its last checkpoint.

    Args:
        archive: The archive.
        metrics: Name of each column to its values (rows,).

    Returns:
        The values up to the last row that has coverage and best fitness of the archive;
        all of them if there is none.
    """
    filled = 100 * np.mean(archive.filled)
    # the file has single precision
    highest = np.float32(np.max(archive.fitnesses))
    same = np.isclose(metrics["coverage"], filled, rtol=1e-5)
    same &= np.float32(metrics["max_fitness"]) == highest
    last = np.flatnonzero(same)[-1:]
    return {
        name: x[: last[0] + 1 if last.size else None] for name, x in metrics.items()
    }


def _metrics(path: Path) -> dict[str, np.ndarray]:
    """Reads ``metrics.csv``.

    Raises:
        ConfigError: It does not exist, or has other columns, values that are not
            numbers, or a last line without an end.
    """
    if not path.is_file():
        allowed = "a results folder with metrics.csv or checkpoint.bin"
        raise ConfigError(message(str(path), Fact("no file"), allowed))
    text = path.read_text(encoding="utf-8")
    if text and not text.endswith("\n"):
        given = Fact("a last line without an end, whose last number may be cut")
        raise ConfigError(message(str(path), given, "whole lines"))
    head, *rows = list(csv.reader(text.splitlines())) or [[]]
    try:
        table = np.asarray([[float(x) for x in row] for row in rows])
        if tuple(head) == COLUMNS[: len(head)] and table.shape[1:] == (len(head),):
            return dict(zip(COLUMNS, complete_metrics(table).T, strict=True))
    except ValueError:
        pass
    allowed = f"numbers with the columns {', '.join(COLUMNS)}"
    raise ConfigError(message(str(path), Fact("other content"), allowed))


def read_reevaluated(path: Path) -> Reevaluated | None:
    """Reads ``corrected.json``, if there is one.

    Returns:
        Its metrics; ``None``, with a warning, if it is damaged.
    """
    if not path.is_file():
        return None
    try:
        return _reevaluated(path.read_text(encoding="utf-8"))
    except (RecursionError, TypeError, ValueError) as error:
        names = ", ".join(f.name for f in dataclasses.fields(Reevaluated))
        text = message(str(path), Fact("other content"), f"an object of {names}")
        text += f" ({error}); the run is opened without these metrics"
        warn(text)
        return None


def _reevaluated(text: str) -> Reevaluated:
    """Returns the metrics of a file.

    Raises:
        TypeError: It has other names, or a value is not a number.
        RecursionError: It has too many lists inside of each other.
        ValueError: It is not JSON.
    """
    found = Reevaluated(**json.loads(text))
    for field in dataclasses.fields(found):
        value = getattr(found, field.name)
        absent = value is None and field.default is None
        if not absent and not checks.is_number(value):  # infinite if none is left
            raise TypeError(message(field.name, value, "numbers"))
    return found
