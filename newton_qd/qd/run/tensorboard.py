"""Metrics of a run as event files for TensorBoard."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from newton_qd.errors import require_extra

_FLUSH_SECONDS = 1  # a killed run loses this part of its curves, but no metrics.csv


class EventLog:
    """Writes the metrics of each generation as scalars."""

    def __init__(self, folder: Path, first: int) -> None:
        """Begins an event file.

        Args:
            folder: Folder of event files; earlier files stay.
            first: Next generation. TensorBoard then drops this and later generations
                from files of a run that was killed after its last checkpoint.

        Raises:
            MissingExtra: tensorboardX is not installed.
        """
        require_extra("tensorboardX", "tensorboard")
        from tensorboardX import SummaryWriter

        self._writer: Any = SummaryWriter(
            str(folder),
            purge_step=first,
            flush_secs=_FLUSH_SECONDS,
            # Without this, two files of the same second would have the same name.
            filename_suffix=f".{first}",
        )

    def write(self, iteration: int, row: Mapping[str, float]) -> None:
        """Writes the metrics after a generation."""
        for name, value in row.items():
            if name != "iteration":
                self._writer.add_scalar(name, value, global_step=iteration)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._writer.close()
