"""Diagnose the gradients of environments, one row of a table for each.

    python benchmarks/doctor.py [--envs ant reacher ...]

Writes the table of docs/gradients.md: `newton-qd doctor gradients NAME --horizons
1,2,4,8,16,32 --worlds 4 --samples 8` for each name. The columns *exact* and *useful*
are the ``exact_horizon`` and the ``useful_horizon`` of its report.
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
    return (
        f"| {name} | {last.seconds:.2g} | {last.alive:.2g} | {last.norm:.3g}, "
        f"{last.largest_norm:.3g} | {growth} | {last.order:.3f} | "
        f"{report.exact_horizon} | {report.useful_horizon} |"
    )


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--envs", nargs="+", default=newton_qd.registered_envs())
    print(
        f"| environment | duration of {HORIZONS[-1]} steps [s] | alive "
        "| norm: median, largest | growth | alpha | exact | useful |\n"
        "|---|---|---|---|---|---|---|---|"
    )
    for name in parser.parse_args().envs:
        print(row(name), flush=True)


if __name__ == "__main__":
    main()
