"""Compares archives after equal numbers of generations, with few worlds on a CPU.

On a GPU, a generation takes nearly the same time with many worlds or few, so a search
has hundreds of generations in a minute. A core of a CPU comes that far only with small
generations. This runs variants of ``study/field.toml`` with a batch of 256, and prints
the corrected QD score (elites are evaluated again from eight start states), as the
median of several seeds with the lowest and highest in brackets:

    python benchmarks/growth.py walker2d_uni me-actor-critic@few \
        me-actor-critic@few-lasting-noise me-actor-critic@few-shared --seeds 3
"""

from __future__ import annotations

import argparse
import dataclasses
import time

import numpy as np
from study_protocols import FIELD
from study_runs import TUNING_SEED, variants

from newton_qd.qd import EvolveConfig, make_task
from newton_qd.qd.run import quality
from newton_qd.qd.run.archive import Archive
from newton_qd.qd.run.search import Search


def growth(
    task_name: str, variant: str, stops: list[int], seed: int
) -> tuple[list[float], float]:
    """Returns the corrected QD score at each stop, and the time of a generation [s].

    Args:
        task_name: Name of the environment.
        variant: Key of ``field.toml``.
        stops: Numbers of generations, rising.
        seed: Seed of every random number.
    """
    given = {**FIELD.settings_of(task_name), "batch_size": 256, **variants()[variant]}
    config = EvolveConfig(
        env_name=task_name,
        algorithm=variant.split("@")[0],
        seed=seed,
        iterations=stops[-1],
        **given,
    )
    task = make_task(config)
    search = Search(config.resolve(task.descriptor_length), task)
    names = [field.name for field in dataclasses.fields(Archive)]
    state, scores, spent = search.empty(), [], []
    for generation in range(1, stops[-1] + 1):
        begin = time.process_time()
        state = search.advance(state)
        spent.append(time.process_time() - begin)
        if generation in stops:
            held = search.checkpoint(state)
            archive = Archive(**{name: getattr(held, name) for name in names})
            found = search.corrected(archive)
            scores.append(quality.offset_qd_score(found, search._generation.offset))
    return scores, float(np.median(spent))


def main() -> None:
    """Prints the scores of each variant."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task")
    parser.add_argument("variants", nargs="+", choices=sorted(variants()))
    parser.add_argument("--stops", type=int, nargs="+", default=[20, 50, 100])
    parser.add_argument("--seeds", type=int, default=1)
    args = parser.parse_args()
    stops = sorted(set(args.stops))
    if stops[0] < 1 or args.seeds < 1:
        parser.error("--stops, --seeds: allowed: integers from 1")
    head = [f"after {stop} generations" for stop in stops]
    print(f"| variant | {' | '.join(head)} | s per generation |")
    print("|---" * (2 + len(stops)) + "|")
    for variant in args.variants:
        runs = [
            growth(args.task, variant, stops, TUNING_SEED + number)
            for number in range(args.seeds)
        ]
        cells = []
        for column in np.array([scores for scores, _ in runs]).T:
            text = f"{np.median(column):,.0f}"
            if args.seeds > 1:
                text += f" ({column.min():,.0f} to {column.max():,.0f})"
            cells.append(text)
        pace = np.median([seconds for _, seconds in runs])
        print(f"| `{variant}` | {' | '.join(cells)} | {pace:.2f} |", flush=True)


if __name__ == "__main__":
    main()
