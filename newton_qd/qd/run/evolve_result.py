"""The result of an evolution."""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path

import numpy as np

from newton_qd.qd.config import EvolveConfig
from newton_qd.qd.run.archive import Archive
from newton_qd.qd.run.progress import results_text
from newton_qd.qd.run.reevaluation import Reevaluated


@dataclasses.dataclass(frozen=True)
class EvolveResult:
    """The result of an evolution.

    Attributes:
        config: Settings with a grid or a number of centroids.
        archive: The elites, one row per cell.
        metrics: Name of each column of ``metrics.csv`` to its values
            (iteration + 1,).
        iteration: Generations that are finished; -1 if a signal came before the
            initial population.
        interrupted: Whether a signal ended the run before its last generation or
            during the re-evaluation.
        out: Results folder, if there is one.
        seconds: Duration of this call [s].
        reevaluated: Metrics of a finished run, from re-evaluated elites.
    """

    config: EvolveConfig
    archive: Archive
    metrics: dict[str, np.ndarray]
    iteration: int
    interrupted: bool
    out: Path | None
    seconds: float
    reevaluated: Reevaluated | None = None

    def __repr__(self) -> str:
        return f"<EvolveResult: {results_text(self.config, self.metrics)}>"

    @property
    def corrected(self) -> Reevaluated | None:
        """Old name of ``reevaluated``."""
        warnings.warn(
            "EvolveResult.corrected is now EvolveResult.reevaluated",
            DeprecationWarning,
            stacklevel=2,
        )
        return self.reevaluated
