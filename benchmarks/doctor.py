"""Diagnose the gradients of environments, one row of a table for each.

    python benchmarks/doctor.py [--envs ant reacher ...]

Writes the table of docs/gradients.md: `newton-qd doctor gradients NAME --horizons
1,2,4,8,16,32 --worlds 4 --samples 8` for each name, of which it takes the longest
horizons over which the worst cosine is above 0.999 (*right*) and over which the first
order has more than half of the weight (*better*).
"""

from __future__ import annotations

import argparse

import newton_qd

HORIZONS = (1, 2, 4, 8, 16, 32)


def row(name: str) -> str:
    """One environment's row."""
    report = newton_qd.diagnose_gradients(name, horizons=HORIZONS, worlds=4, samples=8)
    before, last = report.horizons[-2:]
    growth = "-"  # of a return that does not depend on the actions
    if before.norm:
        steps = last.steps - before.steps
        growth = f"{(last.norm / before.norm) ** (1 / steps):.3f}"
    right, better = (
        max((steps for steps, good in column if good), default=0)
        for column in (
            [(h.steps, h.worst_cosine > 0.999) for h in report.horizons],
            [(h.steps, h.order > 0.5) for h in report.horizons],
        )
    )
    return (
        f"| {name} | {last.seconds:.2g} | {last.alive:.2g} | {last.norm:.3g}, "
        f"{last.largest_norm:.3g} | {growth} | {last.order:.3f} | {right} | "
        f"{better} |"
    )


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--envs", nargs="+", default=newton_qd.registered_envs())
    print(
        f"| environment | duration of {HORIZONS[-1]} steps [s] | alive "
        "| norm: median, largest | growth | alpha | right | better |\n"
        "|---|---|---|---|---|---|---|---|"
    )
    for name in parser.parse_args().envs:
        print(row(name), flush=True)


if __name__ == "__main__":
    main()
