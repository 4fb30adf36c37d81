"""The files of a results folder, read: archive, metrics, re-evaluated elites."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import warnings
from pathlib import Path

import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.run.archive import ARCHIVE, Archive, load_archive
from newton_qd.qd.run.checkpoint import CheckpointError, load_checkpoint
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
    checkpoint = path / CHECKPOINT
    if checkpoint.is_file():  # never older than the archive
        try:
            state = load_checkpoint(checkpoint)
        except CheckpointError as error:
            if not (path / ARCHIVE).is_file():
                raise
            text = f"{error}; its archive and metrics are read from {ARCHIVE} instead"
            warnings.warn(text, stacklevel=3)
        else:
            if config is not None:
                require_same_run(checkpoint, state, config)
            arrays = [getattr(state, f.name) for f in dataclasses.fields(Archive)]
            columns = complete_metrics(np.asarray(state.metrics)).T
            return Archive(*arrays), dict(zip(COLUMNS, columns, strict=True))
    return load_archive(path), _metrics(path / METRICS)


def _metrics(path: Path) -> dict[str, np.ndarray]:
    """Reads ``metrics.csv``.

    Raises:
        ConfigError: It has other columns, or values that are not numbers.
    """
    text = path.read_text(encoding="utf-8")
    head, *rows = list(csv.reader(text.splitlines())) or [[]]
    try:
        table = np.asarray([[float(x) for x in row] for row in rows])
        fits = tuple(head) == COLUMNS[: len(head)] and table.shape[1:] == (len(head),)
        if fits and text.endswith("\n"):  # else the last number may lack digits
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
    except (TypeError, ValueError) as error:
        names = ", ".join(f.name for f in dataclasses.fields(Reevaluated))
        text = message(str(path), Fact("other content"), f"an object of {names}")
        text += f" ({error}); the run is opened without these metrics"
        warnings.warn(text, stacklevel=3)
        return None


def _reevaluated(text: str) -> Reevaluated:
    """Returns the metrics of a file.

    Raises:
        TypeError: It has other names, or a value is not a number.
        ValueError: It is not JSON.
    """
    found = Reevaluated(**json.loads(text))
    for field in dataclasses.fields(found):
        value = getattr(found, field.name)
        absent = value is None and field.default is None
        if not absent and not checks.is_number(value):  # infinite if none is left
            raise TypeError(message(field.name, value, "numbers"))
    return found
