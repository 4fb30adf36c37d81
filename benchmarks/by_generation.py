"""Shows how good an archive is after some generations, whatever their time.

A variant that needs more time for a generation is at a disadvantage on a CPU that it
may not have on a GPU. This compares variants with as many generations. Seed and
settings are those of the protocol ``field``; the scores are corrected.

    python benchmarks/by_generation.py hopper_uni me-actor-critic@11 --generations 80

With ``--then``, another variant of the algorithm goes on from the archive and the
actors of the first one. Both need the same state: as many actors, worlds and so on.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from pathlib import Path

import study_runs
from study_execution import Progress
from study_protocols import FIELD

COLUMNS = {
    "corrected_qd_score": "corrected QD score",
    "corrected_coverage": "corrected coverage [%]",
    "corrected_max_fitness": "corrected best",
    "corrected_mean_fitness": "corrected mean",
}


def _begun(task: str, variant: str, seed: int) -> Progress:
    """Returns a run of the protocol before its first generation."""
    run = study_runs.Run(task, variant, seed)
    with tempfile.TemporaryDirectory() as out:
        return Progress(FIELD, run, Path(out), math.inf)


def main() -> None:
    """Prints a line of the table after each ``--every`` generations."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task", choices=FIELD.tasks)
    parser.add_argument("variant", help="a key of study/field.toml")
    parser.add_argument("--generations", type=int, default=80)
    parser.add_argument("--every", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1000, help="default: the tuning's")
    parser.add_argument(
        "--then",
        nargs=2,
        metavar=("VARIANT", "GENERATIONS"),
        help="variant that goes on after so many generations",
    )
    args = parser.parse_args()
    then, change = args.then or (args.variant, "0")
    for name in (args.variant, then):
        if name not in study_runs.variants():
            parser.error(f"variant: got {name}; allowed: a key of study/field.toml")
    if not change.isdecimal():
        parser.error(f"--then: got {change}; allowed: a variant and an integer")
    for name in ("generations", "every"):
        if getattr(args, name) < 1:
            parser.error(f"{name}: got {getattr(args, name)}; allowed: integers from 1")
    if args.every > args.generations:
        allowed = f"at most --generations = {args.generations}"
        parser.error(f"--every: got {args.every}; allowed: {allowed}")
    search = _begun(args.task, args.variant, args.seed)
    print("| " + " | ".join(["generations", *COLUMNS.values(), "time [s]"]) + " |")
    print("|---" * (len(COLUMNS) + 2) + "|", flush=True)
    begin = time.process_time()
    for number in range(1, args.generations + 1):
        search.advance()
        if number == int(change):
            held = search.search.checkpoint(search.state)
            search = _begun(args.task, then, args.seed)
            search.state = search.search.restore(held)
        if number % args.every == 0:
            found, _ = search.scores()
            scores = [f"{found[name]:,.0f}" for name in COLUMNS]
            scores = [f"{number}", *scores, f"{time.process_time() - begin:.0f}"]
            print("| " + " | ".join(scores) + " |", flush=True)


if __name__ == "__main__":
    main()
