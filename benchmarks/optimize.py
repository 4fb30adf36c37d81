"""Analytic gradients against an evolution strategy, at equal wall-clock time.

    python benchmarks/optimize.py --seeds 10 --out benchmarks/results/optimize.csv
    python benchmarks/optimize.py --plot optimize.png
    python benchmarks/optimize.py --screen ant --seeds 2 --budget 20

Three problems of 250 control steps: a plan of actions for one hopper, whose gradient is
discounted and clipped, and policies for ants and halfcheetahs, by a short-horizon
actor-critic. The strategy is one of evosax (``benchmarks/optimize-requirements.txt``):
for each problem the best of those that ``--screen`` tries, on seeds of its own, which
``CHOSEN`` names.

The two methods take turns in one process, a slice of the budget each, so that what else
the machine does slows both down; on one that is busy, ``--clock processor`` counts the
budget in processor time. Time is that of updates, waited for; compilation and the
evaluations, after every slice, are not part of it. Every run adds lines to the csv
file; runs that are in it already are left out.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import functools
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
from optimize_methods import Evolution, GradientPlan, Method, ShortHorizon
from optimize_problems import PROBLEMS, Problem

from newton_qd.gradients import GradientOptions
from newton_qd.qd.emitters.actor_critic_learner import ActorCriticSettings

METHODS: tuple[str, ...] = ("gradient", "evolution")
SCREENING_SEED = 100  # of the first run of a screening, beyond those of the comparison


@dataclasses.dataclass(frozen=True)
class Point:
    """A line of the csv file: where a run was after a slice of its budget.

    Attributes:
        problem: Name in ``PROBLEMS``.
        method: Name in ``METHODS``, or of a candidate of a screening.
        seed: Seed of every random number of the run.
        wall_s: Wall-clock time of the updates so far [s].
        processor_s: Processor time of the process in them [s].
        updates: Number of updates so far.
        steps: Control steps of worlds that they took.
        value: Return of the present solution: of the best plan so far, or the mean over
            resets of a policy.
    """

    problem: str
    method: str
    seed: int
    wall_s: float
    processor_s: float
    updates: int
    steps: int
    value: float


def gradient_method(problem: Problem) -> Method:
    """The method that follows analytic gradients."""
    if problem.policy is None:
        # a hopper's gradient grows by 1.05 a step; the discount takes that off again
        options = GradientOptions(discount=0.98, clip=1e4, checkpoint_every=None)
        return GradientPlan(
            problem, 64, 0.03, options, caution=4.0, spread=1.0, renewal=10
        )
    settings, hidden = _ACTOR_CRITIC[problem.name]
    return ShortHorizon(problem, settings, hidden)


_ACTOR_CRITIC: dict[str, tuple[ActorCriticSettings, tuple[int, ...]]] = {
    "ant": (
        ActorCriticSettings(
            worlds=32, window=16, clip=300.0, rate=2e-3, noise=0.2, discount=0.95
        ),
        (64, 64),
    ),
    # The more chaotic one: the doctor trusts first orders over 8 steps of open loop.
    "halfcheetah": (
        ActorCriticSettings(
            worlds=128, window=8, clip=30.0, critic=(32, 32), discount=0.98
        ),
        (32, 32),
    ),
}


def candidates(problem: Problem) -> dict[str, Method]:
    """Evolution strategies to choose from."""
    make = functools.partial(Evolution, problem)
    if problem.policy is None:
        return {
            f"{name} {population} {sigma} {rate}": make(
                name, population, 1, sigma, rate
            )
            for name, population, sigma, rate in (
                ("Open_ES", 256, 0.1, 0.03),
                ("Open_ES", 256, 0.3, 0.1),
                ("Open_ES", 64, 0.2, 0.1),
                ("SNES", 256, 0.3, None),
                ("SNES", 64, 0.3, None),
                ("Sep_CMA_ES", 256, 0.3, None),
                ("Sep_CMA_ES", 64, 0.3, None),
                ("CMA_ES", 64, 0.3, None),
            )
        }
    return {
        f"{name} {population}x{resets} {sigma} {rate} {hidden}": make(
            name, population, resets, sigma, rate, hidden
        )
        for name, population, resets, sigma, rate, hidden in (
            ("Open_ES", 128, 2, 0.1, 0.05, ()),
            ("Open_ES", 256, 1, 0.05, 0.02, ()),
            ("Open_ES", 256, 1, 0.1, 0.05, (16,)),
            ("Open_ES", 64, 1, 0.2, 0.1, ()),
            ("SNES", 256, 1, 0.1, None, ()),
            ("SNES", 64, 1, 0.3, None, ()),
            ("Sep_CMA_ES", 64, 4, 0.1, None, ()),
            ("Sep_CMA_ES", 64, 1, 0.3, None, ()),
            ("CMA_ES", 64, 1, 0.1, None, ()),
            ("CMA_ES", 32, 1, 0.3, None, ()),
        )
    }


# Candidate of each problem that the comparison takes, by its place.
CHOSEN: dict[str, int] = {"hopper": 1, "ant": 1, "halfcheetah": 5}


def evolution_method(problem: Problem) -> Method:
    """The evolution strategy that takes part in the comparison."""
    return list(candidates(problem).values())[CHOSEN[problem.name]]


class Run:
    """One method on one seed, with a clock that stands still between its slices."""

    def __init__(self, problem: Problem, name: str, method: Method, seed: int) -> None:
        self.method = method
        self._problem, self._name, self._seed = problem, name, seed
        self._carry = method.init(seed)
        self._wall = self._processor = 0.0
        self._updates, self._best = 0, -float("inf")

    def go_on(self, until: float, clock: str) -> Point:
        """Updates until that much time [s] of a clock is used, then an evaluation."""
        while (self._wall if clock == "wall" else self._processor) < until:
            wall, processor = time.perf_counter(), time.process_time()
            self._carry = jax.block_until_ready(self.method.update(self._carry))
            self._wall += time.perf_counter() - wall
            self._processor += time.process_time() - processor
            self._updates += 1
        keys = self._problem.keys(self._seed)
        solutions = self.method.solutions(self._carry)
        value = float(self._problem.evaluate(solutions, keys))
        if self._problem.policy is None:
            value = self._best = max(value, self._best)
        return Point(
            self._problem.name,
            self._name,
            self._seed,
            round(self._wall, 3),
            round(self._processor, 3),
            self._updates,
            self._updates * self.method.steps,
            round(value, 3),
        )


def race(
    problem: Problem,
    methods: dict[str, Method],
    seed: int,
    budget: float,
    slices: int,
    clock: str,
) -> list[Point]:
    """Runs methods side by side on one seed, in slices of the budget [s] of a clock."""
    runs = [Run(problem, name, method, seed) for name, method in methods.items()]
    points = []
    for part in range(slices + 1):
        # who goes first changes, as what else runs here may change
        for run in runs if part % 2 else runs[::-1]:
            points.append(run.go_on(budget * part / slices, clock))
    return points


def compile_all(problem: Problem, methods: dict[str, Method]) -> None:
    """Compiles everything that a race runs."""
    for method in methods.values():
        carry = jax.block_until_ready(method.update(method.init(0)))
        jax.block_until_ready(
            problem.evaluate(method.solutions(carry), problem.keys(0))
        )


def read(path: Path) -> list[Point]:
    """Points of a csv file, if it exists."""
    if not path.exists():
        return []
    kinds = {field.name: field.type for field in dataclasses.fields(Point)}
    convert: dict[Any, Callable[[str], Any]] = {"str": str, "int": int, "float": float}
    with open(path, newline="", encoding="utf-8") as file:
        return [
            Point(**{name: convert[kinds[name]](text) for name, text in row.items()})
            for row in csv.DictReader(file)
        ]


def append(path: Path, points: Sequence[Point]) -> None:
    """Adds points to a csv file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new = not path.exists()
    names = [field.name for field in dataclasses.fields(Point)]
    with open(path, "a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerows(dataclasses.asdict(point) for point in points)


def final(points: Sequence[Point], problem: str, method: str) -> dict[int, float]:
    """Value at the end of each seed's run."""
    own = [p for p in points if (p.problem, p.method) == (problem, method)]
    return {p.seed: p.value for p in sorted(own, key=lambda p: p.updates)}


def summarize(points: Sequence[Point]) -> None:
    """Prints a table of the values at the end."""
    print(
        "| problem | gradient | evolution | seeds in which the gradient is ahead |\n"
        "|---|---|---|---|"
    )
    for problem in PROBLEMS:
        ends = [final(points, problem, method) for method in METHODS]
        if not all(ends):
            continue
        cells = [
            f"{statistics.mean(x.values()):.0f} "
            f"({min(x.values()):.0f} to {max(x.values()):.0f})"
            for x in ends
        ]
        ahead = sum(ends[0][seed] > ends[1][seed] for seed in ends[0])
        print(f"| {problem} | {' | '.join(cells)} | {ahead} of {len(ends[0])} |")


def plot(points: Sequence[Point], path: Path) -> None:
    """Draws every seed's curve, and the medians."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.2), layout="constrained")
    for axes, problem in zip(figure.subplots(1, len(PROBLEMS)), PROBLEMS, strict=True):
        for method, color in zip(METHODS, ("tab:blue", "tab:orange"), strict=True):
            own = [p for p in points if (p.problem, p.method) == (problem, method)]
            curves = [
                [(p.wall_s, p.value) for p in own if p.seed == seed]
                for seed in sorted({p.seed for p in own})
            ]
            for curve in curves:
                axes.plot(*zip(*curve, strict=True), color=color, lw=0.5, alpha=0.4)
            middle = [
                [statistics.median(values) for values in zip(*part, strict=True)]
                for part in zip(*curves, strict=True)
            ]
            axes.plot(*zip(*middle, strict=True), color=color, lw=2, label=method)
        axes.set_title(problem)
        axes.set_xlabel("wall-clock time [s]")
        axes.set_ylabel("return of 250 steps")
        axes.grid(True, color="0.9")
        axes.legend()
    figure.savefig(path, dpi=100)


def main() -> None:
    """Compares, screens or draws."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--problems", nargs="+", default=list(PROBLEMS))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, help="of those seeds")
    parser.add_argument("--budget", type=float, default=24.0, help="per run [s]")
    parser.add_argument("--clock", choices=("wall", "processor"), default="wall")
    parser.add_argument("--slices", type=int, default=12, help="evaluations of a run")
    parser.add_argument("--out", type=Path, default="benchmarks/results/optimize.csv")
    parser.add_argument("--screen", choices=list(PROBLEMS))
    parser.add_argument("--plot", type=Path)
    options = parser.parse_args()
    if options.plot:
        points = read(options.out)
        if not points:
            parser.error(f"--out: {options.out} holds no runs to draw")
        plot(points, options.plot)
        return
    names = [options.screen] if options.screen else options.problems
    for name in names:
        problem = PROBLEMS[name]()
        if options.screen:
            methods = candidates(problem)
            methods["gradient"] = gradient_method(problem)
        else:
            made = (gradient_method(problem), evolution_method(problem))
            methods = dict(zip(METHODS, made, strict=True))
        compile_all(problem, methods)
        first = options.first_seed
        if first is None:
            first = SCREENING_SEED if options.screen else 0
        seeds = range(first, first + options.seeds)
        settings = (options.budget, options.slices, options.clock)
        for seed in seeds:
            if final(read(options.out), name, METHODS[0]).get(seed) is not None:
                continue
            points = race(problem, methods, seed, *settings)
            if not options.screen:
                append(options.out, points)
            for point in points[-len(methods) :]:
                print(point, flush=True)
    if not options.screen:
        summarize(read(options.out))


if __name__ == "__main__":
    main()
