"""Runs of the protocols ``field`` and ``small`` of ``study.py``, and their scores.

The headline is the corrected QD score: elites are evaluated again from other start
states. Beside it is the same score without offset: the fitness is normalized per task
to 0 for an untrained policy and 1 for the best known one. The best known one is the
best corrected elite of all runs, or a better one in ``study/best_known.csv``.
"""

from __future__ import annotations

import csv
import dataclasses
from collections import Counter
from pathlib import Path

import numpy as np
from study_protocols import OURS
from study_report import interval
from study_runs import TUNING_SEED, chosen, lines

from newton_qd.qd.run import quality

BEST_KNOWN = Path(__file__).resolve().parent / "study" / "best_known.csv"
LEAST_SEEDS = 3  # below, an interval says nothing
MEDIAN = "-median"
"""End of the names of variants of DCRL-ME whose runs were made before a fix.

Each episode was told the median descriptor of its individual. These runs count, too.
"""


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

    A variant without a line is not chosen. Then the one with the most lines is taken,
    of DCRL-ME with as many lines one that was told each episode's descriptor.
    """
    counts = Counter(
        (line["task"], line["algorithm"], line["stop"], line["variant"])
        for line in kept
        if is_variant(line["variant"])
    )
    found = {}

    def rank(key: tuple[str, str, str, str]) -> tuple[int, bool]:
        return counts[key], not key[3].endswith(MEDIAN)

    # later keys replace earlier ones
    for *place, variant in sorted(counts, key=rank):
        task, algorithm, stop = place
        wanted = chosen(algorithm, task, at_evaluations="evaluations" in stop)
        there = (task, algorithm, stop, wanted) in counts
        found[task, algorithm, stop] = wanted if there else variant
    return found


def is_variant(name: str) -> bool:
    """Whether this is an algorithm or a variant of it, and no ablation."""
    number = name.partition("@")[2].removesuffix(MEDIAN)
    return number.isdigit() or "@" not in name


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


def sides_of(
    results: Results, task: str, stop: str, rival: str | None = None
) -> tuple[Side, Side]:
    """Returns our algorithms, with chosen variants, and all variants of others.

    Args:
        results: The runs.
        task: Their task.
        stop: Their stop.
        rival: The only other algorithm that counts; ``None``: all.
    """
    sides: tuple[Side, Side] = [], []
    for (own, algorithm, at), runs in results.items():
        name = algorithm.partition("@")[0]
        other = name not in OURS
        counts = is_variant(algorithm) if other else "@" not in algorithm
        counts &= not other or rival in (None, name)
        if (own, at) == (task, stop) and counts:
            found = [float(run.line["corrected_qd_score"]) for run in runs]
            scores = interval([np.asarray(found)])
            sides[other].append((*scores, algorithm, len(runs)))
    return sides


def to_best_other(
    results: Results, task: str, stop: str, rival: str | None = None
) -> tuple[float, str, int] | None:
    """Compares our best algorithm with the best baseline; enough seeds count first.

    The arguments are those of ``sides_of``.

    Returns:
        Their ratio, whether their intervals overlap, and the number of seeds of that
        which has fewer; or None if one side has no run.
    """
    sides = sides_of(results, task, stop, rival)
    if not all(sides):
        return None
    ours, best = (max(enough(side)) for side in sides)
    seeds = min(ours[4], best[4])
    return *compared(ours[:3], best[:3], seeds), seeds


def enough(side: Side) -> Side:
    """Those with enough seeds, or all if none has."""
    return [one for one in side if one[4] >= LEAST_SEEDS] or side
