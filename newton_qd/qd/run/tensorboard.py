"""Metrics of a run as event files for TensorBoard."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from newton_qd.qd.extras import require_extra

_FLUSH_SECONDS = 1  # what a killed run loses of its curves; metrics.csv loses nothing


class EventLog:
    """Writes the metrics of each generation, as scalars of their names."""

    def __init__(self, folder: Path, first: int) -> None:
        """Begins an event file.

        Args:
            folder: Folder of event files; those of earlier parts of a run stay.
            first: Generation that comes next. TensorBoard then forgets this one and
                later ones of a part that was killed after its last checkpoint.

        Raises:
            MissingExtra: tensorboardX is not installed.
        """
        require_extra("tensorboardX", "tensorboard")
        from tensorboardX import SummaryWriter

        self._writer: Any = SummaryWriter(
            str(folder),
            purge_step=first,
            flush_secs=_FLUSH_SECONDS,
            # Files are named after the second in which they begin.
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
