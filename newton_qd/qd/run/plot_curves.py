"""Learning curves of a run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from newton_qd.errors import require_extra
from newton_qd.qd.config import EvolveConfig
from newton_qd.qd.run.reevaluation import Reevaluated

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PANELS = (
    ("qd_score", "QD score"),
    ("coverage", "coverage [%]"),
    ("max_fitness", "best fitness"),
)


def curves_figure(
    metrics: dict[str, np.ndarray],
    config: EvolveConfig,
    reevaluated: Reevaluated | None = None,
) -> Figure:
    """Draws QD score, coverage and best fitness over the evaluations.

    Args:
        metrics: Name of each column of ``metrics.csv`` to its values (iteration + 1,).
        config: Settings of the run.
        reevaluated: Metrics of re-evaluated elites; they become a mark at the end.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    require_extra("matplotlib", "viz")
    from matplotlib.ticker import EngFormatter

    from newton_qd.figure import NotebookFigure

    figure = NotebookFigure(figsize=(12.0, 4.0), layout="constrained")
    figure.suptitle(f"{config.env_name}: {config.algorithm}, seed {config.seed}")
    evaluations = metrics["evaluations"]
    for axes, (name, label) in zip(figure.subplots(1, 3), _PANELS, strict=True):
        alone = "." if len(evaluations) == 1 else ""
        axes.plot(evaluations, metrics[name], marker=alone, label="archive")
        if reevaluated is not None:
            times = reevaluated.reevaluations
            median = f", medians of {times}" if times > 1 else ""
            axes.plot(
                evaluations[-1:],
                [getattr(reevaluated, name)],
                "o",
                clip_on=False,
                label=f"elites evaluated again{median}",
            )
        axes.set_xlabel("evaluations")
        axes.set_ylabel(label)
        axes.set_xlim(left=0.0)
        axes.grid(alpha=0.3)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        if name == "qd_score":
            axes.yaxis.set_major_formatter(EngFormatter(sep=""))
        if name == "coverage":
            axes.set_ylim(bottom=0.0)
    if reevaluated is not None:
        # below the panels: inside, it would hide a part of the curves
        shown = figure.axes[0].get_legend_handles_labels()
        figure.legend(*shown, loc="outside lower center", ncols=2, frameon=False)
    return figure
