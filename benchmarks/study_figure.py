"""Figure of ``study_scores.py``: how fit the elites are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from study_results import Results, references

from newton_qd.qd.run import quality

LEVELS = np.linspace(0, 1, 101)


def figure(results: Results, stop: str, path: Path) -> None:
    """Plots the distribution of the corrected normalized fitness over cells.

    Ablations and other variants are left out.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    there = {key[0] for key in results if key[2] == stop}
    limits = {k: v for k, v in references(results).items() if k in there}
    names = sorted({key[1] for key in results if "@" not in key[1]})
    columns = min(4, len(limits))
    size = (3.2 * columns, 2.6 * -(-len(limits) // columns))
    drawing, panels = plt.subplots(
        -(-len(limits) // columns), columns, figsize=size, squeeze=False
    )
    drawn = {}  # not every algorithm is in every panel
    for panel, (task, (low, high)) in zip(panels.flat, limits.items(), strict=False):
        for color, name in enumerate(names):
            if runs := results.get((task, name, stop)):
                thresholds = low + LEVELS * (high - low)
                shares = [quality.ccdf(run.corrected, thresholds) for run in runs]
                mean = np.mean(shares, axis=0)
                drawn[name] = panel.plot(LEVELS, mean, f"C{color}", linewidth=1.2)[0]
        panel.set_title(task, fontsize=9)
        panel.tick_params(labelsize=7)
        panel.set_xlabel("normalized fitness", fontsize=8)
    for panel in list(panels.flat)[len(limits) :]:
        panel.axis("off")
    panels[0, 0].set_ylabel("cells at least as fit [%]", fontsize=8)
    panels.flat[0].legend(drawn.values(), drawn.keys(), fontsize=7)
    drawing.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    drawing.savefig(path, dpi=120)
    plt.close(drawing)
