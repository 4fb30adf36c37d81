"""Collect the runs of ``study.py`` in one csv file, and write tables and plots.

    python benchmarks/study_report.py runs --out benchmarks/results/study.csv \
        --figures docs/figures

Scores are interquartile means over seeds (Agarwal et al. 2021, "Deep Reinforcement
Learning at the Edge of the Statistical Precipice", NeurIPS), with percentile bootstrap
intervals of 95 %. Over all tasks, scores are divided by the highest mean of the task,
and seeds are drawn within each task. Two comparisons are made:

- at equal time: where the budget of seconds ends;
- at equal steps: at the largest number of environment steps that all algorithms have
  taken on the task. A step that is differentiated counts as one, too; the column
  "differentiated" has the number of these.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

METRICS = ("qd_score", "coverage", "max_fitness")
KEPT = 20
RESAMPLES = 2000

Curves = dict[tuple[str, str], list[dict[str, np.ndarray]]]
"""The runs of a task and an algorithm, columns by name."""


def load(folder: Path) -> Curves:
    """Reads the files of a folder, named ``TASK.ALGORITHM.SEED.csv``."""
    curves: Curves = {}
    for path in sorted(folder.glob("*.csv")):
        task, algorithm, _ = path.stem.rsplit(".", 2)
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        columns = {name: np.array([float(r[name]) for r in rows]) for name in rows[0]}
        curves.setdefault((task, algorithm), []).append(columns)
    return curves


def collect(curves: Curves, path: Path) -> None:
    """Writes some rows of every run, the last among them, to one file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        head: list[str] = []
        for (task, algorithm), runs in curves.items():
            for seed, run in enumerate(runs):
                if not head:
                    head = ["task", "algorithm", "seed", *run]
                    writer.writerow(head)
                last = len(run["wall_s"]) - 1
                for row in np.unique(np.linspace(0, last, KEPT).astype(int)):
                    values = [f"{run[name][row]:.6g}" for name in head[3:]]
                    writer.writerow([task, algorithm, seed, *values])


def iqm(scores: np.ndarray, axis: int = -1) -> np.ndarray:
    """Interquartile mean along an axis."""
    from scipy.stats import trim_mean

    return np.asarray(trim_mean(scores, 0.25, axis=axis))


def interval(scores: list[np.ndarray], seed: int = 0) -> tuple[float, float, float]:
    """IQM over the seeds of some tasks, and its bootstrap interval of 95 %.

    Args:
        scores: (seeds,) scores of each task.
        seed: Seed of the resampling.
    """
    generator = np.random.default_rng(seed)
    drawn = [
        task[generator.integers(0, len(task), (RESAMPLES, len(task)))]
        for task in scores
    ]
    low, high = np.percentile(iqm(np.concatenate(drawn, axis=1)), [2.5, 97.5])
    return float(iqm(np.concatenate(scores))), float(low), float(high)


def at(run: dict[str, np.ndarray], axis: str, value: float, name: str) -> float:
    """A metric of a run where a count or a time has reached a value."""
    row = int(np.searchsorted(run[axis], value, side="right")) - 1
    return float(run[name][max(row, 0)])


def final(run: dict[str, np.ndarray], name: str) -> float:
    """A metric at the end of a run."""
    return float(run[name][-1])


def common_steps(curves: Curves, task: str) -> float:
    """Environment steps that all runs of a task have taken."""
    runs = [run for key, group in curves.items() if key[0] == task for run in group]
    return min(final(run, "env_steps") for run in runs)


def table(curves: Curves) -> str:
    """Markdown table of every task and algorithm."""
    lines = [
        "| task | algorithm | seeds | QD score at equal time | at equal steps "
        "| coverage [%] | best fitness | corrected QD score | corrected coverage [%] "
        "| steps [M] | differentiated [M] |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for (task, algorithm), runs in sorted(curves.items()):
        steps = common_steps(curves, task)
        qd = _text([final(run, "qd_score") for run in runs], ",.0f")
        same = [at(run, "env_steps", steps, "qd_score") for run in runs]
        cells = [
            _text([final(run, name) for run in runs], spec)
            for name, spec in (
                ("coverage", ".1f"),
                ("max_fitness", ".4g"),
                ("corrected_qd_score", ",.0f"),
                ("corrected_coverage", ".1f"),
            )
        ]
        counts = [
            f"{np.mean([final(run, name) for run in runs]) / 1e6:.3g}"
            for name in ("env_steps", "gradient_steps")
        ]
        row = [task, algorithm, str(len(runs)), qd, _text(same, ",.0f")]
        lines.append(f"| {' | '.join([*row, *cells, *counts])} |")
    return "\n".join(lines)


def _text(scores: list[float], spec: str) -> str:
    middle, low, high = interval([np.array(scores)])
    return f"{middle:{spec}} ({low:{spec}} to {high:{spec}})"


def summary(curves: Curves) -> str:
    """Markdown table of the algorithms over all tasks that each of them has."""
    tasks = sorted({task for task, _ in curves})
    algorithms = sorted({algorithm for _, algorithm in curves})
    kinds: dict[str, Callable[[str, dict], float]] = {
        "QD score at equal time": lambda _, run: final(run, "qd_score"),
        "at equal steps": lambda task, run: at(
            run, "env_steps", common_steps(curves, task), "qd_score"
        ),
        "corrected QD score": lambda _, run: final(run, "corrected_qd_score"),
    }
    lines = [
        f"| algorithm | tasks | {' | '.join(kinds)} |",
        f"|{'---|' * (2 + len(kinds))}",
    ]
    for algorithm in algorithms:
        own = [task for task in tasks if (task, algorithm) in curves]
        cells = []
        for read in kinds.values():
            scores = []
            for task in own:
                groups = {
                    a: np.array([read(task, run) for run in curves[task, a]])
                    for a in algorithms
                    if (task, a) in curves
                }
                best = max(group.mean() for group in groups.values())
                scores.append(groups[algorithm] / best)
            cells.append("{:.3f} ({:.3f} to {:.3f})".format(*interval(scores)))
        lines.append(f"| {algorithm} | {len(own)} | {' | '.join(cells)} |")
    return "\n".join(lines)


def figure(curves: Curves, axis: str, label: str, path: Path) -> None:
    """Plots the QD score of every task over time or steps."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    tasks = sorted({task for task, _ in curves})
    algorithms = sorted({algorithm for _, algorithm in curves})
    columns = min(4, len(tasks))
    rows = -(-len(tasks) // columns)
    size = (3.2 * columns, 2.6 * rows)
    drawing, panels = plt.subplots(rows, columns, figsize=size, squeeze=False)
    for panel, task in zip(panels.flat, tasks, strict=False):
        for color, algorithm in enumerate(algorithms):
            if (task, algorithm) in curves:
                _band(panel, curves[task, algorithm], axis, f"C{color}", algorithm)
        panel.set_title(task, fontsize=9)
        panel.tick_params(labelsize=7)
        panel.set_xlabel(label, fontsize=8)
    for panel in list(panels.flat)[len(tasks) :]:
        panel.axis("off")
    panels[0, 0].set_ylabel("QD score", fontsize=8)
    panels.flat[0].legend(fontsize=7)
    drawing.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    drawing.savefig(path, dpi=120)
    plt.close(drawing)


def _band(
    panel: Any, runs: list[dict[str, np.ndarray]], axis: str, color: str, label: str
) -> None:
    """IQM of some runs with its interval."""
    end = min(final(run, axis) for run in runs)
    grid = np.linspace(min(run[axis][0] for run in runs), end, 40)
    points = [
        interval([np.array([at(run, axis, x, "qd_score") for run in runs])])
        for x in grid
    ]
    middle, low, high = np.array(points).T
    panel.plot(grid, middle, color=color, label=label, linewidth=1.2)
    panel.fill_between(grid, low, high, color=color, alpha=0.2, linewidth=0)


def main() -> None:
    """Writes everything and prints the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--figures", type=Path)
    parser.add_argument("--time", choices=("processor_s", "wall_s"), default="wall_s")
    args = parser.parse_args()
    curves = load(args.runs)
    if not curves:
        allowed = "a folder with files TASK.ALGORITHM.SEED.csv"
        parser.error(f"runs: got {args.runs}; allowed: {allowed}")
    if args.out:
        collect(curves, args.out)
    if args.figures:
        label = "processor time [s]" if args.time == "processor_s" else "time [s]"
        figure(curves, args.time, label, args.figures / "study_time.png")
        figure(
            curves, "env_steps", "environment steps", args.figures / "study_steps.png"
        )
    print(summary(curves), table(curves), sep="\n\n")


if __name__ == "__main__":
    main()
