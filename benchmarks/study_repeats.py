"""How much equal runs of the study differ, and what other ones of them would say.

A run that was made more than once is reported once. The first table has all runs with
the same settings and seed at a stop. The second one has the ratio of our chosen variant
to the best other one with the reported runs, with the least favourable ones (the lowest
of ours and the highest of the other, for each seed), and with the means of all:

    python benchmarks/study_repeats.py benchmarks/results/field \
        benchmarks/results/field_repeats.csv --stop "60 s"
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable
from pathlib import Path
from statistics import fmean

import numpy as np
from study_protocols import BASELINES, OURS
from study_report import interval
from study_runs import TUNING_SEED, chosen, lines, numbered
from study_scores import LEAST_SEEDS

Seeds = dict[int, list[float]]
"""Corrected QD scores by seed; the reported run is first."""
Runs = dict[tuple[str, str], Seeds]
"""By task and variant."""

Pick = Callable[[list[float]], float]
PICKS: dict[str, tuple[Pick, Pick]] = {
    "reported": (lambda runs: runs[0], lambda runs: runs[0]),
    "least favourable": (min, max),
    "means": (fmean, fmean),
}
"""Which run of a seed counts, of ours and of the other."""


def load(folder: Path, repeats: Path, stop: str) -> Runs:
    """Reads the runs at a stop; the seed of the tuning is left out.

    Raises:
        ValueError: No run of ``folder`` came to the stop.
    """
    reported = [line for line in lines(folder) if line["stop"] == stop]
    if not reported:
        known = sorted({line["stop"] for line in lines(folder)})
        raise ValueError(f"stop: {stop!r} has no runs in {folder}; there are {known}")
    with repeats.open(newline="", encoding="utf-8") as file:
        others = [line for line in csv.DictReader(file) if line["stop"] == stop]
    found: Runs = {}
    for line in reported + others:
        if int(line["seed"]) < TUNING_SEED:
            seeds = found.setdefault((line["task"], line["variant"]), {})
            score = float(line["corrected_qd_score"])
            seeds.setdefault(int(line["seed"]), []).append(score)
    return found


def again(runs: Runs) -> str:
    """Markdown table of the runs that were made more than once."""
    rows = ["| task, variant and seed | reported | other runs |", "|---|---|---|"]
    for (task, variant), seeds in sorted(runs.items()):
        for seed, (first, *others) in sorted(seeds.items()):
            if others:
                rest = ", ".join(f"{score:,.0f}" for score in others)
                rows.append(
                    f"| `{task}`, `{variant}`, {seed} | {first:,.0f} | {rest} |"
                )
    return "\n".join(rows)


def ratios(runs: Runs, stop: str) -> str:
    """Markdown table of our chosen variant and the best other one of each task.

    Tasks where neither of them was made again are left out.
    """
    head = " | ".join(PICKS)
    rows = [f"| task | ours | best other | {head} |", "|---" * (3 + len(PICKS)) + "|"]
    for task in sorted({task for task, _ in runs}):
        at = "evaluations" in stop
        ours = [_ours(runs, algorithm, task, at) for algorithm in OURS]
        others = [name for algorithm in BASELINES for name in numbered(algorithm, task)]
        mine, its = (
            {name: runs[task, name] for name in names if (task, name) in runs}
            for names in (ours, others)
        )
        if not mine or not its:
            continue
        own, best = (
            max(side, key=lambda name: _middle(side[name])) for side in (mine, its)
        )
        made = *mine[own].values(), *its[best].values()
        if all(len(scores) == 1 for scores in made):
            continue
        cells = [_compared(mine[own], its[best], *picks) for picks in PICKS.values()]
        rows.append(f"| {task} | {own} | {best} | {' | '.join(cells)} |")
    return "\n".join(rows)


def _ours(runs: Runs, algorithm: str, task: str, at_evaluations: bool) -> str:
    """The chosen variant, or else the one with the most seeds, as in the report."""
    name = chosen(algorithm, task, at_evaluations=at_evaluations)
    if (task, name) in runs:
        return name
    names = numbered(algorithm, task)
    return max(names, key=lambda name: len(runs.get((task, name), {})))


def _middle(seeds: Seeds) -> float:
    """The score of the reported runs."""
    return interval([np.array([scores[0] for scores in seeds.values()])])[0]


def _compared(mine: Seeds, its: Seeds, own: Pick, other: Pick) -> str:
    """The ratio of two variants, and whether their intervals overlap."""
    ours, best = (
        interval([np.array([pick(scores) for scores in seeds.values()])])
        for seeds, pick in ((mine, own), (its, other))
    )
    apart = ours[1] > best[2] or ours[2] < best[1]
    few = min(len(mine), len(its)) < LEAST_SEEDS
    word = "too few seeds" if few else "apart" if apart else "overlap"
    return f"{ours[0] / best[0]:.2f} ({word})"


def main() -> None:
    """Prints both tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="runs that are reported")
    parser.add_argument("repeats", type=Path, help="csv of the others")
    parser.add_argument("--stop", default="60 s", help="as in runs.csv")
    args = parser.parse_args()
    try:
        runs = load(args.folder, args.repeats, args.stop)
    except (OSError, ValueError) as error:
        parser.error(str(error))
    print(again(runs), ratios(runs, args.stop), sep="\n\n")


if __name__ == "__main__":
    main()
