"""Figures of ``study_scores.py``: ratios, and how fit the elites are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from study_results import Results, references, to_best_other

from newton_qd.qd.run import quality

LEVELS = np.linspace(0, 1, 101)


def distribution(results: Results, stop: str, path: Path) -> None:
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


def ratios(results: Results, stops: list[str], path: Path) -> None:
    """Plots our ratio to the best baseline, by task and stop.

    A filled mark: the intervals do not overlap. Tasks with the highest ratios are at
    the top. A stop without a ratio is left out.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    found = {
        (task, stop): one
        for task in sorted({key[0] for key in results})
        for stop in stops
        if (one := to_best_other(results, task, stop))
    }
    stops = [stop for stop in stops if any(key[1] == stop for key in found)]
    highest: dict[str, float] = {}
    for (task, _), (ratio, *_rest) in found.items():
        highest[task] = max(ratio, highest.get(task, 0.0))
    order = sorted(highest, key=highest.__getitem__)
    drawing, panel = plt.subplots(figsize=(7.5, 0.42 * len(order) + 1.1))
    panel.axvline(1, color="0.4", linewidth=1)
    for number, stop in enumerate(stops):
        shift = 0.16 * ((len(stops) - 1) / 2 - number)
        color, mark = f"C{number}", "os^D"[number % 4]
        panel.plot([], [], mark, color=color, label=f"after {stop}")
        for row, task in enumerate(order):
            if (task, stop) in found:
                ratio, word, _ = found[task, stop]
                face = color if word == "apart" else "white"
                panel.plot(ratio, row + shift, mark, color=color, markerfacecolor=face)
    panel.set_xscale("log")
    ticks = (0.8, 1, 1.5, 2, 3, 5, 10, 20, 50)
    panel.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    panel.minorticks_off()
    panel.set_yticks(range(len(order)), order)
    panel.grid(axis="x", color="0.9")
    panel.set_axisbelow(True)
    panel.set_xlabel("corrected QD score: ours as a ratio to the best baseline")
    panel.plot([], [], "ow", markeredgecolor="0.4", label="hollow: not apart")
    panel.legend(fontsize=8, loc="lower right")
    drawing.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    drawing.savefig(path, dpi=120)
    plt.close(drawing)
