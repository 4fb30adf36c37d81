"""Compare robots with brax v1's on the same open-loop sine gaits.

``compare_brax.py --gaits`` calls ``compare``. README.md says what is measured.
"""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

ROBOTS = {"ant": 8, "halfcheetah": 6, "hopper": 3, "walker2d": 6, "humanoid": 17}
OURS, PEER = "newton_qd", "brax_v1"
GAITS, STEPS, SEED = 40, 250, 0
STARTS = 8  # random resets of a mean
# Kinds of gaits: every joint has a frequency of its own, or all have the same one.
KINDS = ("own", "shared")
FREQUENCIES, SEARCH_FREQUENCIES = (0.5, 3.0), (0.5, 5.0)  # of the sines [Hz]
SEARCHED = ("halfcheetah",)
CANDIDATES = 1000  # gaits of a random search
# A cross-entropy search; its spread never falls below a share of the whole range.
GENERATIONS, POPULATION, ELITE, LEAST_SPREAD, SEARCHES = 10, 200, 20, 0.02, 4
DEFAULT_POSE = -1  # start without noise, instead of the seed of a reset

HEAD = """# Sine gaits in newton_qd and in brax v1

Written by `benchmarks/compare_brax.py --gaits`. README.md explains the columns.
"""

Ask = Callable[..., dict[str, Any]]


@dataclasses.dataclass(frozen=True)
class Simulation:
    """One simulation of a comparison: a row of the table for each robot.

    Attributes:
        label: Name in the table.
        library: Worker that runs it.
        options: Changes to the library's own simulation.
        first_seed: Seed of the first of the random resets.
    """

    label: str
    library: str
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    first_seed: int = 0


REFERENCE = Simulation("brax v1", PEER)
# What the reference itself leaves open.
VARIANTS = (
    Simulation("brax v1, other starts", PEER, first_seed=STARTS),
    Simulation("brax v1, half the substep", PEER, {"scale_substeps": 2}),
    Simulation("brax v1, position-based", PEER, {"legacy_spring": False}),
)


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Result of a robot's gaits in one simulation.

    Attributes:
        returns: (gaits,) up to the end of the episode, mean over the random starts.
        endless: (gaits,) the same, as if no fall ended the episode.
        first: (gaits,) return from the default pose alone.
        forward: (gaits,) way along x in all steps, mean over the starts [m].
        steps: (gaits,) length of the episode, mean over the starts.
        noise: Standard deviation over the starts, root of the mean square over gaits.
        faults: Worlds with a fault.
    """

    returns: np.ndarray
    endless: np.ndarray
    first: np.ndarray
    forward: np.ndarray
    steps: np.ndarray
    noise: float
    faults: int


def decode(unit: np.ndarray, kind: str, frequencies: tuple[float, float]) -> np.ndarray:
    """Returns gaits: amplitude [-], frequency [Hz] and phase [rad] of each action.

    Args:
        unit: (gaits, nu, 3) coordinates from 0 to 1.
        kind: One of ``KINDS``; of a shared frequency, the first action decides.
        frequencies: Lowest and highest frequency [Hz].
    """
    low, high = frequencies
    amplitude, frequency, phase = np.moveaxis(unit, -1, 0)
    if kind == "shared":
        frequency = np.repeat(frequency[:, :1], frequency.shape[1], axis=1)
    columns = (amplitude, low + (high - low) * frequency, 2 * np.pi * phase)
    return np.stack(columns, axis=-1)


def draw(
    count: int, actions: int, kind: str, frequencies: tuple[float, float]
) -> np.ndarray:
    """Returns random gaits (count, actions, 3), the same for every library."""
    unit = np.random.default_rng(SEED).random((count, actions, 3))
    return decode(unit, kind, frequencies)


def rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Returns Spearman's coefficient; equal values share their mean rank."""
    ranks = []
    for values in (a, b):
        _, place, count = np.unique(values, return_inverse=True, return_counts=True)
        ranks.append((np.cumsum(count) - (count - 1) / 2)[place])
    return float(np.corrcoef(*ranks)[0, 1])


def run(ask: Ask, simulation: Simulation, robot: str, gaits: np.ndarray) -> Outcome:
    """Runs gaits from the default pose and from all random starts."""
    first = simulation.first_seed
    found = ask(
        "gaits",
        robot=robot,
        gaits=gaits.tolist(),
        seeds=[DEFAULT_POSE, *range(first, first + STARTS)],
        steps=STEPS,
        options=simulation.options,
    )
    parts = {name: np.asarray(values) for name, values in found.items()}
    means = {
        name: parts[name][1:].mean(axis=0)
        for name in ("returns", "endless", "forward", "steps")
    }
    return Outcome(
        **means,
        first=parts["returns"][0],
        noise=float(np.sqrt(parts["returns"][1:].var(axis=0).mean())),
        faults=found["faults"],
    )


def first_returns(
    ask: Ask, simulation: Simulation, robot: str, gaits: np.ndarray
) -> np.ndarray:
    """Returns the returns (gaits,) from the default pose."""
    found = ask(
        "gaits",
        robot=robot,
        gaits=gaits.tolist(),
        seeds=[DEFAULT_POSE],
        steps=STEPS,
        options=simulation.options,
    )
    return np.asarray(found["returns"][0])


def search(
    ask: Ask, simulation: Simulation, robot: str, seed: int
) -> tuple[float, np.ndarray]:
    """Returns the best return of a cross-entropy search, and its gait (1, nu, 3).

    Every simulation gets the same random numbers.
    """
    random = np.random.default_rng(seed)
    shape = (POPULATION, ROBOTS[robot], 3)
    unit = random.random(shape)
    best, winner = -np.inf, unit[:1]
    for _ in range(GENERATIONS):
        gaits = decode(unit, "shared", SEARCH_FREQUENCIES)
        scores = first_returns(ask, simulation, robot, gaits)
        order = np.argsort(-scores)
        if scores[order[0]] > best:
            best, winner = float(scores[order[0]]), gaits[order[:1]]
        elite = unit[order[:ELITE]]
        # Phases are angles: their mean is that of points on a circle.
        mean = elite.mean(axis=0)
        mean[:, 2] = np.angle(np.exp(2j * np.pi * elite[..., 2]).mean(axis=0))
        mean[:, 2] /= 2 * np.pi
        off = elite - mean
        off[..., 2] = (off[..., 2] + 0.5) % 1 - 0.5
        spread = np.sqrt(np.square(off).mean(axis=0)) + LEAST_SPREAD
        unit = mean + spread * random.standard_normal(shape)
        unit[..., 2] %= 1
        unit[..., :2] = unit[..., :2].clip(0, 1)
    return best, winner


def compare(
    asks: dict[str, Ask], robots: list[str], ours: dict[str, Any], folder: Path | None
) -> str:
    """Runs the comparison.

    Args:
        asks: Function that sends a command to a worker, by library. Without the peer,
            only this project's numbers are in the tables.
        robots: Names of the environments.
        ours: Changes to this project's simulation.
        folder: Folder for ``gaits.md``, ``gaits.csv`` and ``gaits_search.csv``;
            ``None``: no files.

    Returns:
        The tables as Markdown.
    """
    label = OURS if not ours else f"{OURS} {json.dumps(ours, sort_keys=True)}"
    project = Simulation(label, OURS, ours)
    simulations = [
        one for one in (REFERENCE, *VARIANTS, project) if one.library in asks
    ]
    outcomes = {}
    for robot in robots:
        for kind in KINDS:
            gaits = draw(GAITS, ROBOTS[robot], kind, FREQUENCIES)
            for one in simulations:
                found = run(asks[one.library], one, robot, gaits)
                outcomes[robot, kind, one.label] = found
                mean = found.returns.mean()
                print(f"{robot}, {kind}, {one.label}: {mean:.1f}", flush=True)
    searches = search_all(asks, simulations, [r for r in robots if r in SEARCHED])
    text = table(outcomes)
    if searches:
        text += f"\n\n{search_table(searches)}"
    if folder is not None:
        write(folder, outcomes, searches)
        (folder / "gaits.md").write_text(f"{HEAD}\n{text}\n", encoding="utf-8")
    return text


def search_all(
    asks: dict[str, Ask], simulations: list[Simulation], robots: list[str]
) -> list[dict[str, Any]]:
    """Returns the best gaits of all searches: a row per robot, search, simulation."""
    rows = []
    own_starts = [one for one in simulations if not one.first_seed]
    for robot in robots:
        candidates = draw(CANDIDATES, ROBOTS[robot], "shared", SEARCH_FREQUENCIES)
        for one in own_starts:
            ask = asks[one.library]
            scores = first_returns(ask, one, robot, candidates)
            winner = candidates[scores.argmax()][None]
            found = [("random", float(scores.max()), winner)]
            for seed in range(SEARCHES):
                found.append((f"evolved {seed}", *search(ask, one, robot, seed)))
            for name, best, gait in found:
                again = run(ask, one, robot, gait)
                rows.append(
                    {
                        "robot": robot,
                        "search": name,
                        "simulation": one.label,
                        "best_return": best,
                        "of_random_starts": float(again.returns[0]),
                        "forward_m": float(again.forward[0]),
                    }
                )
                print(f"{robot}, {one.label}, {name}: best {best:.1f}", flush=True)
    return rows


def table(outcomes: dict[tuple[str, str, str], Outcome]) -> str:
    """Returns the comparison of all gaits as a Markdown table."""
    lines = [
        "| robot | frequency | simulation | mean return | ratio to brax v1 | without "
        "ends: mean return | ratio | rank correlation: means | one start | forward "
        "[m] | steps | deviation over starts |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for (robot, kind, label), found in outcomes.items():
        count = len(found.returns) ** 0.5
        cells = [
            robot,
            kind,
            label,
            f"{found.returns.mean():.1f} ± {found.returns.std() / count:.1f}",
        ]
        reference = outcomes.get((robot, kind, REFERENCE.label))
        endless = f"{found.endless.mean():.1f}"
        if reference is None:
            cells += ["-", endless, "-", "-", "-"]
        else:
            ratio = found.returns.mean() / reference.returns.mean()
            others = found.endless.mean() / reference.endless.mean()
            means = rank_correlation(found.returns, reference.returns)
            first = rank_correlation(found.first, reference.first)
            cells += [f"{ratio:.2f}", endless, f"{others:.2f}"]
            cells += [f"{means:.2f}", f"{first:.2f}"]
        cells += [
            f"{found.forward.mean():.2f}",
            f"{found.steps.mean():.0f}",
            f"{found.noise:.1f}",
        ]
        if found.faults:
            cells[2] += f" ({found.faults} faults)"
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def search_table(rows: list[dict[str, Any]]) -> str:
    """Returns the best gaits as a Markdown table; means over the evolved searches."""
    lines = [
        "| robot | search | simulation | best return | ratio to brax v1 | from random "
        "starts | forward [m] |",
        "|---|---|---|---|---|---|---|",
    ]
    groups: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for row in rows:
        kind = row["search"].split()[0]
        groups.setdefault((row["robot"], kind, row["simulation"]), []).append(row)
    for (robot, kind, label), group in sorted(groups.items()):
        best = [row["best_return"] for row in group]
        cells = [robot, kind, label, f"{np.mean(best):.0f}"]
        if len(group) > 1:
            cells[-1] += f" ({min(best):.0f} to {max(best):.0f})"
        reference = groups.get((robot, kind, REFERENCE.label))
        if reference is None:
            cells.append("-")
        else:
            whole = np.mean([row["best_return"] for row in reference])
            cells.append(f"{np.mean(best) / whole:.2f}")
        cells.append(f"{np.mean([row['of_random_starts'] for row in group]):.0f}")
        cells.append(f"{np.mean([row['forward_m'] for row in group]):.1f}")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def write(
    folder: Path,
    outcomes: dict[tuple[str, str, str], Outcome],
    searches: list[dict[str, Any]],
) -> None:
    """Writes the csv files."""
    columns = ("returns", "endless", "first", "forward", "steps")
    with (folder / "gaits.csv").open("w", newline="", encoding="utf-8") as file:
        lines = csv.writer(file, lineterminator="\n")
        lines.writerow(["robot", "frequency", "simulation", "gait", *columns])
        for (*names, label), found in outcomes.items():
            values = zip(*(getattr(found, name) for name in columns), strict=True)
            for gait, numbers in enumerate(values):
                lines.writerow([*names, label, gait, *(f"{x:.4g}" for x in numbers)])
    if searches:
        path = folder / "gaits_search.csv"
        with path.open("w", newline="", encoding="utf-8") as file:
            rows = csv.DictWriter(file, list(searches[0]), lineterminator="\n")
            rows.writeheader()
            for row in searches:
                rounded = {
                    name: f"{x:.5g}" if isinstance(x, float) else x
                    for name, x in row.items()
                }
                rows.writerow(rounded)
