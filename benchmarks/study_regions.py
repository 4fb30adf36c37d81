"""Fitness of the elites by region of the descriptor, for a task of the study.

A table of the mean fitness of re-evaluated elites, by range of the mean of the
descriptor's components, which is scaled to 0 to 1. Each number is a mean over the seeds
that have elites there; in brackets is the share of the cells that have an elite [%], a
mean over all seeds:

    python benchmarks/study_regions.py benchmarks/results/field walker2d_uni \
        me-actor-critic@14 dcrl-me@6-median me@5 --ranges 0.2 0.4 0.6 0.8 1
"""

from __future__ import annotations

import argparse
import functools
import itertools
import math
from pathlib import Path

import numpy as np
from study_protocols import FIELD
from study_runs import TUNING_SEED, lines

from newton_qd.qd.run import quality


@functools.cache
def cells_of(task_name: str, seed: int) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Returns the centres of a run's cells (cells, D), and the limits, two of (D,)."""
    from newton_qd.qd import EvolveConfig, make_task
    from newton_qd.qd.run.search import Search

    settings = FIELD.settings_of(task_name)
    config = EvolveConfig(env_name=task_name, algorithm="me", seed=seed, **settings)
    task = make_task(config)
    search = Search(config.resolve(task.descriptor_length), task)
    return np.asarray(search.empty().repertoire.centroids), task.limits


def places(task_name: str, seed: int) -> np.ndarray:
    """Returns the mean of the components of each cell's centre (cells,), in 0 to 1."""
    centres, (low, high) = cells_of(task_name, seed)
    return ((centres - low) / (high - low)).mean(axis=1)


def seeds_of(folder: Path, task_name: str, variant: str, stop: str) -> list[int]:
    """Returns the seeds of a variant that came to a stop, without that of the tuning.

    Raises:
        ValueError: There is none.
    """
    wanted = task_name, variant, stop
    found = [
        int(line["seed"])
        for line in lines(folder)
        if (line["task"], line["variant"], line["stop"]) == wanted
        and int(line["seed"]) != TUNING_SEED
    ]
    if not found:
        raise ValueError(f"got {variant}; allowed: one with a run at {stop}")
    return sorted(found)


def regions(
    places: np.ndarray, fitnesses: np.ndarray, limits: list[float]
) -> list[tuple[float, float]]:
    """Returns mean fitness and share of filled cells [%] of each region.

    Args:
        places: (cells,) place of each cell.
        fitnesses: (cells,) fitness of each cell, ``-inf`` if it is empty.
        limits: Where regions end, in increasing order. The last one includes its end.

    Returns:
        One pair for each region. The mean of a region without elites is NaN; the share
        of a region without cells is 0.
    """
    found = []
    for low, high in itertools.pairwise(limits):
        last = high == limits[-1]
        inside = (places >= low) & ((places < high) | (last & (places <= high)))
        own = fitnesses[inside]
        if own.size:
            share = float(quality.coverage(own))
            found.append((float(quality.mean_fitness(own)), share))
        else:
            found.append((math.nan, 0.0))
    return found


def cell(each: list[tuple[float, float]]) -> str:
    """Returns the text of a region: mean fitness and share of filled cells.

    Args:
        each: Mean fitness and share of each seed.
    """
    means = [mean for mean, share in each if share > 0]
    share = np.mean([share for _, share in each])
    return f"{np.mean(means):.0f} ({share:.0f} %)" if means else "-"


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path)
    parser.add_argument("task", choices=FIELD.tasks)
    parser.add_argument("variants", nargs="+")
    parser.add_argument("--stop", default="60 s")
    parser.add_argument(
        "--ranges", type=float, nargs="+", default=[0, 0.25, 0.5, 0.75, 1]
    )
    args = parser.parse_args()
    if len(args.ranges) < 2 or sorted(set(args.ranges)) != args.ranges:
        parser.error(
            f"--ranges: got {args.ranges}; allowed: two or more rising numbers"
        )
    columns = []
    for variant in args.variants:
        try:
            seeds = seeds_of(args.runs, args.task, variant, args.stop)
        except ValueError as error:
            parser.error(f"variants: {error}")
        each = []
        for seed in seeds:
            path = args.runs / "cells" / f"{args.task}.{variant}.{seed}.npz"
            fitnesses = np.load(path)[args.stop][1]
            each.append(regions(places(args.task, seed), fitnesses, args.ranges))
        columns.append([cell(list(pairs)) for pairs in zip(*each, strict=True)])
    print(f"| descriptor | {' | '.join(args.variants)} |")
    print("|---" * (1 + len(columns)) + "|")
    ranges = itertools.pairwise(args.ranges)
    for (low, high), *cells in zip(ranges, *columns, strict=True):
        print(f"| {low:g} to {high:g} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
