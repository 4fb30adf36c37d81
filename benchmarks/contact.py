"""Measure what contact must hold, for every robot of the suite and for a hexapod.

    python benchmarks/contact.py energy [--robots ant hexapod] [--worlds 128]
    python benchmarks/contact.py drops
    python benchmarks/contact.py state
    python benchmarks/contact.py order --worlds 64
    python benchmarks/contact.py friction
    python benchmarks/contact.py light
    python benchmarks/contact.py gradients --worlds 32 [--robots halfcheetah ant]

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

``order`` takes actions of half amplitude over 0.15 s, or the nearest number of control
steps, from reset states and from busy ones, 1 s later. Errors are of the coordinate
with the largest error, against 64 times the substeps; the table has medians over the
worlds.

``friction`` takes the motions of ``energy``. A contact counts in a substep if its
normal impulse is above a millionth of the robot's weight over this time.

``light`` counts faults of hexapods under noise, and follows the energy of an acrobot
that swings without actions, with and without a contact that touches nothing. Drift is
a share of the kinetic energy at the start.

``gradients`` has norms of the gradient of the return over 32 steps with respect to the
actions, from different resets, and horizons of ``newton_qd.diagnose_gradients``.
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

import contact_measures as measures
import energy_helpers as energies
import subjects

import newton_qd

Row = dict[str, Any]


def energy(options: argparse.Namespace) -> Iterator[Row]:
    """Gains of every robot under every kind of action."""
    for name in options.robots:
        for kind in options.actions:
            start = time.perf_counter()
            one = subjects.subject(name)
            found = energies.driven(one, kind, options.worlds, options.steps)
            gain, bare = energies.judge(found), energies.judge(found, elastic=False)
            yield {
                "robot": name,
                "h [ms]": 1e3 * one.system.h,
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
        one = subjects.subject(name)
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
    found = energies.fast_feet(subjects.subject("halfcheetah").system)
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


def order(options: argparse.Namespace) -> Iterator[Row]:
    """Errors of 0.15 s of motion for h, h/2 and h/4, and their order in h."""
    for name in options.robots:
        one = subjects.subject(name)
        starts = {"reset": one.reset, "busy": lambda n, one=one: measures.busy(one, n)}
        for start, states in starts.items():
            found = measures.errors(one, *states(options.worlds))
            medians = np.median(found, axis=1)
            yield {
                "robot": name,
                "h [ms]": 1e3 * one.system.h,
                "start": start,
                "error at h": medians[0],
                "at h/2": medians[1],
                "at h/4": medians[2],
                "order, h to h/2": np.log2(medians[0] / medians[1]),
                "order, h/2 to h/4": np.log2(medians[1] / medians[2]),
                "90 % at h": np.quantile(found[0], 0.9),
            }


def friction(options: argparse.Namespace) -> Iterator[Row]:
    """How far friction leaves its cone."""
    for name in options.robots:
        one = subjects.subject(name)
        if not len(one.system.contact_body) or not one.system.robot.material.friction:
            continue
        ratios = measures.friction_ratios(one, options.worlds, options.steps)
        yield {
            "robot": name,
            "contacts": len(ratios),
            "median": np.median(ratios),
            "99 %": np.quantile(ratios, 0.99),
            "99.9 %": np.quantile(ratios, 0.999),
            "99.99 %": np.quantile(ratios, 0.9999),
            "largest": ratios.max(),
            "share above 1.5": (ratios > 1.5).mean(),
        }


def light(options: argparse.Namespace) -> Iterator[Row]:
    """Faults of hexapods, and drift of an acrobot that could touch the ground."""
    for name in subjects.HEXAPODS:
        found = measures.faults(subjects.subject(name), 64, options.long)
        yield {
            "robot": name,
            "motion": f"{options.long} steps of noise",
            "worlds with faults": (found > 0).mean(),
            "largest drift": "-",
        }
    systems = {
        "acrobot, a contact": measures.touching_acrobot(),
        "acrobot": subjects.subject("acrobot").system,
    }
    for name, system in systems.items():
        for speed in (5.0, 10.0, 15.0):
            drift, found = measures.drift(system, speed, 8, 30.0)
            yield {
                "robot": name,
                "motion": f"30 s from {speed:g} rad/s",
                "worlds with faults": (found > 0).mean(),
                "largest drift": np.abs(drift).max(),
            }


def gradients(options: argparse.Namespace) -> Iterator[Row]:
    """Norms of gradients over 32 steps, and the horizon of the gradient doctor."""
    for name in options.robots if len(options.robots) < 9 else ["halfcheetah"]:
        norms = measures.gradient_norms(name, options.worlds, 32)
        report = newton_qd.diagnose_gradients(name, horizons=(1, 2, 4, 8, 16, 32))
        yield {
            "robot": name,
            "median norm": np.median(norms),
            "25 %": np.quantile(norms, 0.25),
            "75 %": np.quantile(norms, 0.75),
            "largest": norms.max(),
            "exact horizon": report.exact_horizon,
            "useful horizon": report.useful_horizon,
            "norm in its report": report.horizons[-1].norm,
        }


COMMANDS: dict[str, Callable[[argparse.Namespace], Iterator[Row]]] = {
    "energy": energy,
    "drops": drops,
    "state": state,
    "order": order,
    "friction": friction,
    "light": light,
    "gradients": gradients,
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
    parser.add_argument("--robots", nargs="+", default=subjects.SUBJECTS)
    parser.add_argument("--actions", nargs="+", default=subjects.ACTIONS)
    parser.add_argument("--worlds", type=int, default=128)
    parser.add_argument("--steps", type=int, default=250)
    parser.add_argument("--poses", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=4.0, help="of a drop")
    parser.add_argument("--long", type=int, default=10_000, help="steps of hexapods")
    parser.add_argument("--out", type=Path)
    return parser.parse_args()


def main() -> None:
    """Prints the table of a command."""
    options = parse()
    jax.config.update("jax_enable_x64", True)
    show(COMMANDS[options.command](options), options.out)


if __name__ == "__main__":
    main()
