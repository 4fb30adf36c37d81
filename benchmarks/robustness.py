"""What several start states per individual are worth, at equal numbers of episodes.

    python benchmarks/robustness.py [--env ant_uni] [--generations 400] [--seeds 2]

Each setting has as many episodes as MAP-Elites with one start state. The archive is
rebuilt from elites that are evaluated 32 times again, and its metrics are what counts.
The table has means over the seeds, and the processor time of a run with compiling and
re-evaluation [s].
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

from newton_qd.qd import EvolveConfig, evolve

SETTINGS: tuple[dict[str, Any], ...] = (
    {"starts": 1},
    {"starts": 1, "new_starts": True},
    {"starts": 4},
    {"starts": 4, "statistic": "median"},
    {"starts": 4, "new_starts": True},
    {"starts": 4, "scatter": 1.0},
    {"starts": 4, "scatter": 3.0},
    {"starts": 4, "statistic": "median", "scatter": 1.0},
    {"starts": 16},
)


def measured(config: EvolveConfig) -> list[float]:
    """Coverage and score in the archive and corrected, and processor time [s]."""
    begin = time.process_time()
    result = evolve(config, progress=False)
    seconds = time.process_time() - begin
    again = result.reevaluated
    assert again is not None
    last = {name: column[-1] for name, column in result.metrics.items()}
    return [
        last["coverage"],
        again.coverage,
        last["qd_score"],
        again.qd_score,
        again.max_fitness,
        seconds,
    ]


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--env", default="ant_uni")
    parser.add_argument("--generations", type=int, default=400)
    parser.add_argument("--seeds", type=int, default=2)
    arguments = parser.parse_args()
    print(
        "| settings | coverage [%] | corrected | QD score | corrected | best | time |"
    )
    print("|---|---|---|---|---|---|---|")
    for settings in SETTINGS:
        iterations = arguments.generations // settings["starts"]
        rows = [
            measured(
                EvolveConfig(
                    env_name=arguments.env, iterations=iterations, seed=seed, **settings
                )
            )
            for seed in range(arguments.seeds)
        ]
        cells = " | ".join(f"{value:,.1f}" for value in np.mean(rows, axis=0))
        text = ", ".join(f"{name}={value}" for name, value in settings.items())
        print(f"| {text} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
