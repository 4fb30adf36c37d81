"""Tables and figures of the protocols ``field`` and ``small`` of ``study.py``.

    python benchmarks/study_scores.py field --out docs/field.md --figures docs/figures

The headline is the corrected QD score: elites are evaluated again from other start
states. Beside it is the same score without offset: the fitness is normalized per task
to 0 for an untrained policy and 1 for the best known one. The best known one is the
best corrected elite of all runs, or a better one in ``study/best_known.csv``. Scores
are interquartile means over seeds with bootstrap intervals of 95 %.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import itertools
from collections import Counter
from pathlib import Path

import numpy as np
from study_protocols import OURS, PROTOCOLS
from study_report import interval
from study_runs import TUNING_SEED, chosen, lines

from newton_qd.qd.run import quality

BEST_KNOWN = Path(__file__).resolve().parent / "study" / "best_known.csv"
PUBLISHED = {
    "hopper_uni": {"me": 401, "pga-me": 474, "dcrl-me": 527, "ascii-me": 680},
    "walker2d_uni": {"me": 434, "pga-me": 542, "dcrl-me": 645, "ascii-me": 767},
}
"""Medians of QD scores [thousands] at a million evaluations (Mitsides et al. 2025)."""
LEVELS = np.linspace(0, 1, 101)
LEAST_SEEDS = 3  # below, an interval says nothing

Key = tuple[str, str, str]
"""Task, algorithm and stop."""


@dataclasses.dataclass(frozen=True)
class Scored:
    """A run at a stop.

    Attributes:
        seed: Its seed.
        line: Its line of ``runs.csv``.
        raw: (cells,) fitness of each cell.
        corrected: (cells,) the same after another evaluation of the elites.
    """

    seed: int
    line: dict[str, str]
    raw: np.ndarray
    corrected: np.ndarray


Results = dict[Key, list[Scored]]


def load(folder: Path) -> Results:
    """Reads the runs of a folder; the seed of the tuning is left out.

    The variant of an algorithm that ``field.toml`` chooses for a task has the
    algorithm's name, at each stop to which it came. Others have their own, as if they
    were algorithms of their own.
    """
    kept = [line for line in lines(folder) if int(line["seed"]) != TUNING_SEED]
    main = main_variants(kept)
    found: Results = {}
    for line in kept:
        name = f"{line['task']}.{line['variant']}.{line['seed']}.npz"
        cells = np.load(folder / "cells" / name)[line["stop"]].astype(np.float64)
        place = line["task"], line["algorithm"], line["stop"]
        own = main.get(place) == line["variant"]
        key = line["task"], line["algorithm" if own else "variant"], line["stop"]
        found.setdefault(key, []).append(Scored(int(line["seed"]), line, *cells))
    return found


def main_variants(kept: list[dict[str, str]]) -> dict[tuple[str, str, str], str]:
    """Returns the chosen variant, by task, algorithm and stop; no ablations.

    A variant without a line is not chosen. Then the one with the most lines is taken.
    """
    counts = Counter(
        (line["task"], line["algorithm"], line["stop"], line["variant"])
        for line in kept
        if is_variant(line["variant"])
    )
    found = {}
    # later keys replace earlier ones
    for *place, variant in sorted(counts, key=lambda key: counts[key]):
        task, algorithm, stop = place
        wanted = chosen(algorithm, task, at_evaluations="evaluations" in stop)
        there = (task, algorithm, stop, wanted) in counts
        found[task, algorithm, stop] = wanted if there else variant
    return found


def is_variant(name: str) -> bool:
    """Whether this is an algorithm or a variant of it, and no ablation."""
    return name.partition("@")[2].isdigit() or "@" not in name


def best_known() -> dict[str, float]:
    """Returns the best known fitness of each task."""
    if not BEST_KNOWN.is_file():
        return {}
    with BEST_KNOWN.open(newline="", encoding="utf-8") as file:
        return {row["task"]: float(row["fitness"]) for row in csv.DictReader(file)}


def note_best(results: Results) -> None:
    """Writes the best corrected fitnesses of runs where they are better than known."""
    best = best_known() | {
        task: high for task, (_, high) in references(results).items()
    }
    unfinished = BEST_KNOWN.with_suffix(".unfinished")
    with unfinished.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("task", "fitness"))
        writer.writerows((task, f"{best[task]:.7g}") for task in sorted(best))
    unfinished.replace(BEST_KNOWN)


def references(results: Results) -> dict[str, tuple[float, float]]:
    """Returns the fitness of an untrained policy and the best known one, by task."""
    known = best_known()
    found = {}
    for task in sorted({key[0] for key in results}):
        runs = [
            run for key, group in results.items() if key[0] == task for run in group
        ]
        untrained = np.median([float(run.line["initial_fitness"]) for run in runs])
        best = max(quality.best(run.corrected) for run in runs)
        best = max(best, known.get(task, -np.inf))
        found[task] = float(untrained), float(best)
    return found


def common(results: Results, task: str, stop: str) -> dict[str, list[float]]:
    """Mean corrected fitness over the cells that all algorithms fill, by algorithm.

    Runs with the same seed have the same cells, so seeds are compared one by one.
    """
    groups = {key[1]: runs for key, runs in results.items() if key[::2] == (task, stop)}
    seeds = set.intersection(*({run.seed for run in runs} for runs in groups.values()))
    found: dict[str, list[float]] = {name: [] for name in groups}
    for seed in sorted(seeds):
        archives = [
            next(run.corrected for run in runs if run.seed == seed)
            for runs in groups.values()
        ]
        means = quality.common_mean_fitness(archives)
        for name, mean in zip(groups, means, strict=True):
            if np.isfinite(mean):
                found[name].append(float(mean))
    return found


def normalized(run: Scored, limits: tuple[float, float]) -> float:
    """The corrected QD score without offset of a run."""
    return quality.normalized_qd_score(run.corrected, *limits)


def text(values: list[float], spec: str) -> str:
    """Interquartile mean and its interval; one value has none."""
    if not values:
        return "-"
    if len(values) == 1:
        return f"{values[0]:{spec}}"
    middle, low, high = interval([np.asarray(values)])
    return f"{middle:{spec}} ({low:{spec}} to {high:{spec}})"


def table(results: Results, stop: str) -> str:
    """Markdown table of all tasks and algorithms at a stop."""
    limits = references(results)
    head = (
        *("task", "algorithm", "seeds", "**corrected QD score**", "**without offset**"),
        *("corrected mean fitness over common cells", "corrected coverage [%]"),
        *("corrected best", "QD score", "coverage [%]", "best"),
        *("evaluations [k]", "time [s]"),
    )
    rows = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    keys = sorted(key for key in results if key[2] == stop)
    for task, group in itertools.groupby(keys, key=lambda key: key[0]):
        shared = common(results, task, stop)
        for key in group:
            runs = results[key]

            def column(name: str, runs: list[Scored] = runs) -> list[float]:
                return [float(run.line[name]) for run in runs]

            clock = "wall_s" if runs[0].line["device"] == "cuda" else "processor_s"
            cells = (
                *(task, key[1], str(len(runs))),
                text(column("corrected_qd_score"), ",.0f"),
                text([normalized(run, limits[task]) for run in runs], ".4f"),
                text(shared[key[1]], ".4g"),
                text(column("corrected_coverage"), ".1f"),
                text(column("corrected_max_fitness"), ".4g"),
                text(column("qd_score"), ",.0f"),
                text(column("coverage"), ".1f"),
                text(column("max_fitness"), ".4g"),
                f"{np.mean(column('evaluations')) / 1e3:.0f}",
                f"{np.mean(column(clock)):.0f}",
            )
            rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def compared(
    ours: tuple[float, float, float], other: tuple[float, float, float], seeds: int
) -> tuple[float, str]:
    """Returns the ratio of two scores, and whether their intervals overlap.

    Args:
        ours: Middle, low and high of our score.
        other: The same of another one.
        seeds: Number of seeds of that which has fewer.
    """
    ratio = ours[0] / other[0] if other[0] > 0 else np.inf
    if seeds < LEAST_SEEDS:
        return ratio, "too few seeds"
    apart = ours[1] > other[2] or ours[2] < other[1]
    return ratio, "apart" if apart else "overlap"


Side = list[tuple[float, float, float, str, int]]
"""Middle, low and high of the corrected QD score, algorithm, and number of seeds."""


def _sides(results: Results, task: str, stop: str) -> tuple[Side, Side]:
    """Returns our algorithms, with chosen variants, and all variants of others."""
    sides: tuple[Side, Side] = [], []
    for (own, algorithm, at), runs in results.items():
        other = algorithm.split("@")[0] not in OURS
        counts = is_variant(algorithm) if other else "@" not in algorithm
        if (own, at) == (task, stop) and counts:
            found = [float(run.line["corrected_qd_score"]) for run in runs]
            scores = interval([np.asarray(found)])
            sides[other].append((*scores, algorithm, len(runs)))
    return sides


def overview(results: Results) -> str:
    """Markdown table: our ratio to the best other algorithm, by task and stop.

    Those with enough seeds count first. Bold: the intervals do not overlap.
    """
    stops = sorted({key[2] for key in results}, key=lambda stop: (len(stop), stop))
    rows = [f"| task | {' | '.join(stops)} |", "|---" * (1 + len(stops)) + "|"]
    for task in sorted({key[0] for key in results}):
        cells = []
        for stop in stops:
            sides = _sides(results, task, stop)
            if not all(sides):
                cells.append("-")
                continue
            ours, best = (max(_enough(side)) for side in sides)
            seeds = min(ours[4], best[4])
            ratio, word = compared(ours[:3], best[:3], seeds)
            mark = "**" if word == "apart" else ""
            few = f" ({seeds} of {LEAST_SEEDS} seeds)" if seeds < LEAST_SEEDS else ""
            cells.append(f"{mark}{ratio:.2f}{mark}{few}")
        rows.append(f"| {task} | {' | '.join(cells)} |")
    return "\n".join(rows)


def _enough(side: Side) -> Side:
    """Those with enough seeds, or all if none has."""
    return [one for one in side if one[4] >= LEAST_SEEDS] or side


def verdict(results: Results, stop: str) -> str:
    """Markdown table: our best algorithm and the best other one of each task.

    Ours has the chosen variant. Others have the one that is best here.
    """
    rows = [
        "| task | our best: corrected QD score | best other | ratio | intervals |",
        "|---|---|---|---|---|",
    ]
    for task in sorted({key[0] for key in results}):
        sides = _sides(results, task, stop)
        if not all(sides):
            continue
        ours, best = (max(side) for side in sides)
        seeds = min(ours[4], best[4])
        ratio, word = compared(ours[:3], best[:3], seeds)
        cells = [f"{x[3]} {x[0]:,.0f}" for x in (ours, best)]
        if seeds >= LEAST_SEEDS:
            pairs = zip(cells, (ours, best), strict=True)
            cells = [f"{cell} ({x[1]:,.0f} to {x[2]:,.0f})" for cell, x in pairs]
        rows.append(f"| {task} | {' | '.join(cells)} | {ratio:.2f} | {word} |")
    return "\n".join(rows)


def published(results: Results) -> str:
    """Markdown table: ratios to MAP-Elites with a million evaluations, and published.

    The published scores have no offset, and neither have these. They are of a single
    evaluation of each individual, as in the first variant of each algorithm.
    """
    rows = ["| task | algorithm | ratio here | published |", "|---|---|---|---|"]
    for task, scores in PUBLISHED.items():
        sums: dict[str, list[float]] = {}
        for (own, _, stop), runs in results.items():
            name, number = runs[0].line["variant"].split("@")
            if (own, stop, number) == (task, "1000000 evaluations", "1"):
                sums[name] = [run.raw[np.isfinite(run.raw)].sum() for run in runs]
        if "me" not in sums:
            continue
        base = np.median(sums["me"])
        for name in [name for name in scores if name in sums]:
            ratio, other = np.median(sums[name]) / base, scores[name] / scores["me"]
            rows.append(f"| {task} | {name} | {ratio:.2f} | {other:.2f} |")
    return "\n".join(rows) if len(rows) > 2 else ""


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


def report(results: Results) -> str:
    """Returns all tables."""
    parts = ["## Overview", overview(results)]
    for stop in dict.fromkeys(key[2] for key in sorted(results, key=lambda k: k[2])):
        parts += [f"## At {stop}", verdict(results, stop), table(results, stop)]
    if ratios := published(results):
        parts += ["## Ratios to MAP-Elites", ratios]
    return "\n\n".join(parts) + "\n"


def main() -> None:
    """Prints the tables, and writes them and the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--out", type=Path, help="Markdown file of the tables")
    parser.add_argument("--figures", type=Path)
    parser.add_argument(
        "--note-best",
        action="store_true",
        help="add the best elites of these runs to study/best_known.csv",
    )
    args = parser.parse_args()
    results = load(args.runs)
    if args.note_best:
        note_best(results)
    known = {str(x) for protocol in PROTOCOLS.values() for x in protocol.stops}
    stops = sorted({key[2] for key in results} & known)
    if args.figures:
        for stop in stops:
            name = f"study_ccdf_{stop.replace(' ', '_')}.png"
            figure(results, stop, args.figures / name)
    content = report(results)
    if args.out:
        args.out.write_text(content, encoding="utf-8")
    print(content)


if __name__ == "__main__":
    main()
