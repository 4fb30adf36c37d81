"""Measure what contact must hold, for every robot of the suite and for a hexapod.

    python benchmarks/contact.py energy [--robots ant hexapod] [--worlds 128]
    python benchmarks/contact.py drops
    python benchmarks/contact.py state

All in float64 on the CPU. ``--out FILE`` also writes the rows as csv.

``energy`` moves worlds from reset states under random actions, sines and bang-bang
actions, and counts the energy that each substep gains beyond the work of the motors.
Energy is kinetic, of gravity, of springs and elastic, in limits and contacts. The bar
is for all of it: at most 2 J, or 1 % of the world's largest kinetic energy. The columns
*without elastic* leave out what limits and contacts store, which bodies get back.

``drops`` lets go of poses with any joint angles above the ground. Their energy may
rise over the first by 0.1 % of what they can spend: the first energy above the lowest
potential energy that the world reaches.

``state`` is a halfcheetah with fast feet: its energy in every substep of two control
steps, without actions.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

import energy_helpers as energies

Row = dict[str, Any]


def energy(options: argparse.Namespace) -> Iterator[Row]:
    """Gains of every robot under every kind of action."""
    for name in options.robots:
        for kind in options.actions:
            start = time.perf_counter()
            one = energies.subject(name)
            found = energies.driven(one, kind, options.worlds, options.steps)
            gain, bare = energies.judge(found), energies.judge(found, elastic=False)
            yield {
                "robot": name,
                "h [ms]": 1e3 * one.system.robot.dt / one.system.robot.substeps,
                "actions": kind,
                "gain [J]": gain.largest,
                "of kinetic": gain.share,
                "worlds beyond": gain.worlds,
                "substeps beyond": gain.substeps,
                "without elastic [J]": bare.largest,
                "of kinetic, without": bare.share,
                "worlds beyond, without": bare.worlds,
                "kinetic [J]": found.largest_kinetic.max(),
                "faults": gain.faults,
                "time [s]": time.perf_counter() - start,
            }


def drops(options: argparse.Namespace) -> Iterator[Row]:
    """Largest rise of the energy of poses that are let go."""
    for name in options.robots:
        one = energies.subject(name)
        found = energies.dropped(one, options.poses, options.seconds)
        total = np.asarray(found.energy.total)
        yield {
            "robot": name,
            "largest rise": energies.excess(found).max(),
            "largest rise [J]": (total - total[0]).max(),
            "largest gain of a substep [J]": found.gains().max(),
            "median energy to spend [J]": np.median(
                total[0] - np.asarray(found.energy.potential).min(axis=0)
            ),
            "faults": np.asarray(found.fault).any(axis=0).mean(),
        }


def state(options: argparse.Namespace) -> Iterator[Row]:
    """Energy of a halfcheetah with fast feet, substep by substep."""
    del options
    found = energies.fast_feet(energies.subject("halfcheetah").system)
    total = np.asarray(found.energy.total)[:, 0]
    for n, value in enumerate(total):
        yield {
            "substep": n,
            "kinetic [J]": found.energy.kinetic[n, 0],
            "elastic [J]": found.energy.elastic[n, 0],
            "without elastic [J]": found.energy.rigid[n, 0],
            "total [J]": value,
            "change [J]": value - total[max(n - 1, 0)],
        }


COMMANDS: dict[str, Callable[[argparse.Namespace], Iterator[Row]]] = {
    "energy": energy,
    "drops": drops,
    "state": state,
}


def text(value: Any) -> str:
    """A value of a table."""
    return value if isinstance(value, str) else f"{value:.4g}"


def show(rows: Iterator[Row], out: Path | None) -> None:
    """Prints rows as a table while they come, and writes them as csv."""
    found = []
    for row in rows:
        if not found:
            print(f"| {' | '.join(row)} |\n|{'---|' * len(row)}")
        print(f"| {' | '.join(map(text, row.values()))} |", flush=True)
        found.append(row)
    if out is not None:
        with out.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, found[0])
            writer.writeheader()
            writer.writerows(found)


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("command", choices=COMMANDS)
    parser.add_argument("--robots", nargs="+", default=energies.SUBJECTS)
    parser.add_argument("--actions", nargs="+", default=energies.ACTIONS)
    parser.add_argument("--worlds", type=int, default=128)
    parser.add_argument("--steps", type=int, default=250)
    parser.add_argument("--poses", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=4.0, help="of a drop")
    parser.add_argument("--out", type=Path)
    return parser.parse_args()


def main() -> None:
    """Prints the table of a command."""
    options = parse()
    jax.config.update("jax_enable_x64", True)
    show(COMMANDS[options.command](options), options.out)


if __name__ == "__main__":
    main()
