"""Seconds per generation of each algorithm of ``evolve``, on the present device.

    python benchmarks/algorithms.py [--env ant_uni] [--algorithm pga-me]

Two generations come before the measured ones, because they compile. The table has the
shortest and the median wall time of a generation, and its processor time.
"""

from __future__ import annotations

import argparse
import time

import jax
import numpy as np

from newton_qd.qd.algorithms import ALGORITHMS
from newton_qd.qd.config import EvolveConfig
from newton_qd.qd.run.search import Search
from newton_qd.qd.scoring.task import make_task


def generation_times(config: EvolveConfig, generations: int) -> np.ndarray:
    """Wall and processor time (generations, 2) [s] of generations."""
    task = make_task(config)
    search = Search(config.resolve(task.descriptor_length), task)
    state = search.empty()
    for _ in range(3):  # the initial population, and two generations
        state = search.advance(state)
    times = []
    for _ in range(generations):
        wall, processor = time.perf_counter(), time.process_time()
        state = search.advance(state)
        jax.block_until_ready(state.repertoire)
        times.append((time.perf_counter() - wall, time.process_time() - processor))
    return np.asarray(times)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--env", default="ant_uni")
    parser.add_argument("--algorithm", action="append", help="default: all")
    parser.add_argument("--generations", type=int, default=3)
    arguments = parser.parse_args()
    print("| `--algorithm` | shortest [s] | median [s] | processor time [s] |")
    print("| --- | --- | --- | --- |")
    for name in arguments.algorithm or [spec.name for spec in ALGORITHMS]:
        config = EvolveConfig(env_name=arguments.env, algorithm=name)
        times = generation_times(config, arguments.generations)
        wall, processor = times.T
        print(
            f"| `{name}` | {wall.min():.2f} | {np.median(wall):.2f} | "
            f"{np.median(processor):.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
