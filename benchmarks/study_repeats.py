"""How much equal runs of the study differ, and what other ones of them would say.

A run that was made more than once is reported once. The first table says how much runs
with the same settings and seed differ at a stop. The second one has the ratio of our
chosen variant to the best baseline with the reported runs, with the least favourable
ones (the lowest of ours and the highest of the other, for each seed), and with the
means of all:

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
from study_protocols import OURS
from study_report import interval
from study_results import LEAST_SEEDS, compared, is_variant, main_variants
from study_runs import TUNING_SEED, lines
from study_scores import markdown

Seeds = dict[int, list[float]]
"""Corrected QD scores by seed; the reported run is first."""
Runs = dict[tuple[str, str], Seeds]
"""By task and variant."""

CLOSE = 1.15
"""Ratio of the highest to the lowest of equal runs below which they hardly differ."""

Pick = Callable[[list[float]], float]
PICKS: dict[str, tuple[Pick, Pick]] = {
    "reported": (lambda runs: runs[0], lambda runs: runs[0]),
    "least favourable": (min, max),
    "means": (fmean, fmean),
}
"""Which run of a seed counts, of ours and of the other."""


def load(folder: Path, repeats: Path, stop: str) -> tuple[Runs, set[tuple[str, str]]]:
    """Reads the runs at a stop; the seed of the tuning is left out.

    Returns:
        The runs, and task and variant of those that the report names by the algorithm.

    Raises:
        ValueError: No run of ``folder`` came to the stop.
    """
    kept = [line for line in lines(folder) if int(line["seed"]) != TUNING_SEED]
    reported = [line for line in kept if line["stop"] == stop]
    if not reported:
        known = sorted({line["stop"] for line in kept})
        raise ValueError(f"stop: {stop!r} has no runs in {folder}; there are {known}")
    with repeats.open(newline="", encoding="utf-8") as file:
        others = [
            line
            for line in csv.DictReader(file)
            if line["stop"] == stop and int(line["seed"]) != TUNING_SEED
        ]
    found: Runs = {}
    for line in reported + others:
        seeds = found.setdefault((line["task"], line["variant"]), {})
        score = float(line["corrected_qd_score"])
        seeds.setdefault(int(line["seed"]), []).append(score)
    main = main_variants(reported)
    return found, {(task, variant) for (task, _, _), variant in main.items()}


def again(runs: Runs) -> tuple[str, str]:
    """Sentence and Markdown table about the seeds that were run more than once."""
    rows = []
    every: list[float] = []
    for (task, variant), seeds in sorted(runs.items()):
        equal = [scores for _, scores in sorted(seeds.items()) if len(scores) > 1]
        if equal:
            spread = [max(scores) / min(scores) for scores in equal]
            every += spread
            counts = ", ".join(str(len(scores)) for scores in equal)
            ratio = ", ".join(f"{ratio:.2f}" for ratio in spread)
            rows.append([task, variant, counts, ratio])
    close = sum(ratio < CLOSE for ratio in every)
    first = f"Of {len(every)} groups of equal runs, {close} differ by less than"
    head = "task", "variant", "runs of each seed", "highest to lowest"
    return f"{first} {100 * (CLOSE - 1):.0f} %.", markdown(head, rows)


def ratios(runs: Runs, main: set[tuple[str, str]]) -> str:
    """Markdown table of our chosen variant and the best baseline of each task.

    Tasks where neither of them was made again are left out.
    """
    rows = []
    for task in sorted({task for task, _ in runs}):
        sides: tuple[dict[str, Seeds], dict[str, Seeds]] = {}, {}
        for (own, name), seeds in runs.items():
            other = name.partition("@")[0] not in OURS
            if own == task and (is_variant(name) if other else (task, name) in main):
                sides[other][name] = seeds
        if not all(sides):
            continue
        ours, best = (_best(side) for side in sides)
        pair = sides[0][ours], sides[1][best]
        if all(len(scores) == 1 for seeds in pair for scores in seeds.values()):
            continue
        cells = [_compared(*pair, *picks) for picks in PICKS.values()]
        rows.append([task, ours, best, *cells])
    return markdown(["task", "ours", "best baseline", *PICKS], rows)


def _best(side: dict[str, Seeds]) -> str:
    """The variant with the highest score; those with enough seeds count first."""
    enough = [name for name in side if len(side[name]) >= LEAST_SEEDS]
    return max(enough or side, key=lambda name: _middle(side[name]))


def _middle(seeds: Seeds) -> float:
    """The score of the reported runs."""
    return interval([np.array([scores[0] for scores in seeds.values()])])[0]


def _compared(mine: Seeds, its: Seeds, own: Pick, other: Pick) -> str:
    """The ratio of two variants, and whether their intervals overlap."""
    ours, best = (
        interval([np.array([pick(scores) for scores in seeds.values()])])
        for seeds, pick in ((mine, own), (its, other))
    )
    ratio, word = compared(ours, best, min(len(mine), len(its)))
    return f"{ratio:.2f} ({word})"


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
        runs, named = load(args.folder, args.repeats, args.stop)
    except (OSError, ValueError) as error:
        parser.error(str(error))
    print(*again(runs), ratios(runs, named), sep="\n\n")


if __name__ == "__main__":
    main()
