"""Runs of a protocol of the study: their variants, their lines, and which are missing.

A folder of runs has one line in ``runs.csv`` for each stop of each run.
``study_execution.py`` writes them.
"""

from __future__ import annotations

import csv
import dataclasses
import fcntl
import functools
import tomllib
from pathlib import Path
from typing import Any

from study_protocols import Protocol

VARIANTS = Path(__file__).resolve().parent / "study" / "field.toml"
TUNING_SEED = 1000
_ABOUT = {"of", "tasks", "chosen", "chosen_at_evaluations"}  # no settings
SCORES = ("qd_score", "coverage", "max_fitness", "mean_fitness", "qd_gain")
HEAD = (
    *("protocol", "task", "algorithm", "variant", "seed", "stop", "device", "clock"),
    *("commit", "wall_s", "processor_s", "iteration", "evaluations", "env_steps"),
    *("gradient_steps", "rejected", "initial_fitness", *SCORES),
    *(f"corrected_{name}" for name in SCORES),
)


@dataclasses.dataclass(frozen=True)
class Run:
    """A run of a protocol.

    Attributes:
        task: Name of the environment.
        variant: Key of ``field.toml``, such as ``me@1``.
        seed: Seed of every random number.
    """

    task: str
    variant: str
    seed: int

    @property
    def algorithm(self) -> str:
        """Name of the algorithm, such as ``me``."""
        return self.variant.split("@")[0]

    def __str__(self) -> str:
        return f"{self.task}.{self.variant}.{self.seed}"


def variants() -> dict[str, dict[str, Any]]:
    """Returns the settings of all variants; number 0 has the defaults of ``evolve``."""
    found: dict[str, dict[str, Any]] = {}
    for name, given in _file().items():
        parent = found[given["of"]] if "of" in given else {}
        own = {key: given[key] for key in given.keys() - _ABOUT}
        options = {**parent.get("options", {}), **given.get("options", {})}
        found[name] = {**parent, **own, **({"options": options} if options else {})}
    algorithms = dict.fromkeys(name.split("@")[0] for name in found)
    return {**found, **{f"{algorithm}@0": {} for algorithm in algorithms}}


def _file() -> dict[str, dict[str, Any]]:
    """Returns the content of ``field.toml``; do not change it."""
    return _content(VARIANTS, VARIANTS.stat().st_mtime_ns)


@functools.lru_cache(maxsize=1)
def _content(path: Path, changed: int) -> dict[str, Any]:
    """Returns the content of a TOML file that was last changed at a time [ns]."""
    del changed
    with path.open("rb") as file:
        return tomllib.load(file)


def lines(out: Path) -> list[dict[str, str]]:
    """Returns the lines of ``runs.csv`` of a folder."""
    path = out / "runs.csv"
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def best_variant(tuning: Path, task: str, algorithm: str) -> str:
    """Returns the variant with the highest corrected QD score without offset.

    Raises:
        FileNotFoundError: None was tried.
    """
    scores: dict[str, float] = {}
    for line in lines(tuning):
        if (line["task"], line["algorithm"]) == (task, algorithm):
            # later stops replace earlier ones
            scores[line["variant"]] = float(line["corrected_qd_gain"])
    if not scores:
        raise FileNotFoundError(f"{tuning} holds no run of {algorithm} on {task}")
    return max(scores, key=lambda name: scores[name])


def numbered(algorithm: str, task: str) -> list[str]:
    """Returns the variants that tuning tries on a task; others are ablations."""
    found = []
    for name, given in _file().items():
        own, number = name.split("@")
        if own == algorithm and number.isdigit() and task in given.get("tasks", [task]):
            found.append(name)
    return found


def chosen(algorithm: str, task: str, *, at_evaluations: bool = False) -> str:
    """Returns the variant that the report has for a task, or else the first one.

    Args:
        algorithm: Name of the algorithm.
        task: Name of the environment.
        at_evaluations: Whether the stop is a number of evaluations. There, more start
            states leave fewer generations, so another variant may be chosen.
    """
    names, file = numbered(algorithm, task), _file()
    for key in ("chosen_at_evaluations",) * at_evaluations + ("chosen",):
        for name in names:
            if task in file[name].get(key, ()):
                return name
    return names[0]


@dataclasses.dataclass(frozen=True)
class Choice:
    """Which runs of a protocol a command asks for.

    Attributes:
        tasks: Names of the environments.
        algorithms: Names of the algorithms.
        seeds: Largest number of seeds.
        until: Longest time of a run [s].
        reach: Whether runs go on after that until they have their evaluations.
        tune: Whether to run every variant with the seed of the tuning.
        tuned: Folder of the tuning; ``None``: the variants of the report, or for a
            protocol with defaults those.
        variants: Variants to run instead of the algorithms; ``None``: none.
    """

    tasks: list[str]
    algorithms: list[str]
    seeds: int
    until: float
    reach: bool = False
    tune: bool = False
    tuned: Path | None = None
    variants: list[str] | None = None


def planned(protocol: Protocol, choice: Choice) -> list[Run]:
    """Returns the runs of a choice.

    Seeds come first, so that a study that was stopped has all tasks and algorithms.
    """
    if choice.variants:
        seeds = [TUNING_SEED] if choice.tune else range(choice.seeds)
        return [
            Run(task, variant, seed)
            for seed in seeds
            for task in choice.tasks
            for variant in choice.variants
            if protocol.has(task, variant.split("@")[0])
        ]
    kinds = [
        (task, algorithm)
        for task in choice.tasks
        for algorithm in choice.algorithms
        if protocol.has(task, algorithm)
    ]
    if choice.tune:
        return [
            Run(task, variant, TUNING_SEED)
            for task, algorithm in kinds
            for variant in numbered(algorithm, task)
        ]
    found = []
    for seed in range(choice.seeds):
        for task, algorithm in kinds:
            if seed < protocol.seeds_of(algorithm):
                if choice.tuned:
                    variant = best_variant(choice.tuned, task, algorithm)
                elif protocol.defaults:
                    variant = f"{algorithm}@0"
                else:
                    variant = chosen(algorithm, task)
                found.append(Run(task, variant, seed))
    return found


def finished(protocol: Protocol, out: Path) -> set[tuple[str, str, int, str]]:
    """Returns task, variant, seed and stop of all lines of a folder."""
    return {
        (line["task"], line["variant"], int(line["seed"]), line["stop"])
        for line in lines(out)
        if line["protocol"] == protocol.name
    }


def other_protocols(protocol: Protocol, out: Path) -> set[str]:
    """Returns the names of other protocols that have lines in a folder."""
    return {line["protocol"] for line in lines(out)} - {protocol.name}


def missing(protocol: Protocol, out: Path, choice: Choice) -> list[Run]:
    """Returns the runs of a choice without a line for one of their stops.

    Args:
        protocol: The protocol.
        out: Folder of the runs.
        choice: The runs to look at.
    """
    done = finished(protocol, out)
    within = protocol.stops_until(choice.until)
    stops = [str(stop) for stop in within if stop.unit == "s" or choice.reach]
    # slow algorithms may not reach a number of evaluations
    stops = stops or [*map(str, within)]
    return [
        run
        for run in planned(protocol, choice)
        if any((run.task, run.variant, run.seed, stop) not in done for stop in stops)
    ]


def listed(path: Path, protocol: Protocol, out: Path) -> list[tuple[Run, float]]:
    """Returns the runs of a list that are not finished, each with its longest time [s].

    Args:
        path: File with a line ``TASK VARIANT SEED UNTIL`` for each run.
        protocol: The protocol.
        out: Folder of the runs.

    Raises:
        ValueError: A line is none of a run.
    """
    done, found = finished(protocol, out), []
    stops = {f"{x.amount:g}": str(x) for x in protocol.stops if x.unit == "s"}
    for line in filter(str.strip, path.read_text(encoding="utf-8").splitlines()):
        words = line.split()
        task, variant, seed, until = words if len(words) == 4 else ("",) * 4
        sound = task in protocol.tasks and variant in variants() and seed.isdecimal()
        if not sound or until not in stops:
            raise ValueError(
                f"{path}: got {line!r}; allowed: TASK VARIANT SEED UNTIL, with a task "
                f"of the protocol, a variant of {VARIANTS.name}, an integer from 0, "
                f"and one of {', '.join(stops)}"
            )
        if (task, variant, int(seed), stops[until]) not in done:
            found.append((Run(task, variant, int(seed)), float(until)))
    return found


def add_line(path: Path, line: dict[str, str], head: tuple[str, ...] = HEAD) -> None:
    """Adds a line to a csv file that several processes write to."""
    with path.open("a", newline="", encoding="utf-8") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.seek(0, 2)
        writer = csv.DictWriter(file, head, lineterminator="\n")
        if file.tell() == 0:
            writer.writeheader()
        writer.writerow(line)
