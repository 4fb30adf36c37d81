"""Runs of a protocol of the study: stopped, continued, and written line by line.

A run adds one line to ``runs.csv`` at each of its stops, and the fitness of each cell
to ``cells/RUN.npz``. Scores of re-evaluated elites are part of the line; for them, the
clock is stopped. A run that is stopped leaves ``states/RUN.bin``, from which the next
command continues; it is removed when the run has reached its last stop.
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import fcntl
import json
import math
import os
import subprocess
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from study_protocols import Protocol, Stop

VARIANTS = Path(__file__).resolve().parent / "study" / "field.toml"
TUNING_SEED = 1000
SCORES = ("qd_score", "coverage", "max_fitness", "mean_fitness", "qd_gain")
HEAD = (
    *("protocol", "task", "algorithm", "variant", "seed", "stop", "device", "commit"),
    *("wall_s", "processor_s", "iteration", "evaluations", "env_steps"),
    *("gradient_steps", "rejected", "initial_fitness", *SCORES),
    *(f"corrected_{name}" for name in SCORES),
)
_SAVED_EVERY = 60.0  # seconds of a run between two copies of its state


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


@dataclasses.dataclass
class Spent:
    """What a run has used so far, without compilation and re-evaluations.

    Attributes:
        wall_s: Wall-clock time [s].
        processor_s: Time of all processor cores [s].
    """

    wall_s: float = 0.0
    processor_s: float = 0.0

    def add(self, begin: tuple[float, float]) -> None:
        """Adds the time since ``now``."""
        wall, processor = now()
        self.wall_s += wall - begin[0]
        self.processor_s += processor - begin[1]


def now() -> tuple[float, float]:
    """Returns wall-clock and processor time [s]."""
    return time.perf_counter(), time.process_time()


def variants() -> dict[str, dict[str, Any]]:
    """Returns the settings of all variants."""
    with VARIANTS.open("rb") as file:
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


def numbered(algorithm: str) -> list[str]:
    """Returns the variants of an algorithm that tuning tries; others are ablations."""
    names = [name.split("@") for name in variants()]
    return [f"{algorithm}@{x}" for own, x in names if own == algorithm and x.isdigit()]


def missing(
    protocol: Protocol,
    out: Path,
    *,
    tasks: list[str],
    algorithms: list[str],
    seeds: int,
    until: float,
    tune: bool = False,
    tuned: Path | None = None,
    chosen_variants: list[str] | None = None,
) -> list[Run]:
    """Returns the runs without a line for one of their stops.

    Seeds come first, so that a study that was stopped has all tasks and algorithms.

    Args:
        protocol: The protocol.
        out: Folder of the runs.
        tasks: Names of the environments.
        algorithms: Names of the algorithms.
        seeds: Largest number of seeds.
        until: Longest time of a run [s].
        tune: Whether to run every variant with the seed of the tuning.
        tuned: Folder of the tuning; ``None``: the first variant of each algorithm.
        chosen_variants: Variants to run instead of the algorithms; ``None``: none.
    """
    kinds = [(t, a) for t in tasks for a in algorithms if protocol.has(t, a)]
    planned: list[Run] = []
    if chosen_variants:
        planned = [
            Run(task, variant, seed)
            for seed in range(seeds)
            for task in tasks
            for variant in chosen_variants
        ]
    elif tune:
        for task, algorithm in kinds:
            own = numbered(algorithm)
            planned += [Run(task, variant, TUNING_SEED) for variant in own]
    else:
        for seed in range(seeds):
            for task, algorithm in kinds:
                if seed < protocol.seeds_of(algorithm):
                    chosen = f"{algorithm}@1"
                    if tuned:
                        chosen = best_variant(tuned, task, algorithm)
                    planned.append(Run(task, chosen, seed))
    done = {
        (line["task"], line["variant"], int(line["seed"]), line["stop"])
        for line in lines(out)
        if line["protocol"] == protocol.name
    }
    within = protocol.stops_until(until)
    # slow algorithms may not reach a number of evaluations
    stops = [str(stop) for stop in within if stop.unit == "s"] or [*map(str, within)]
    return [
        run
        for run in planned
        if any((run.task, run.variant, run.seed, stop) not in done for stop in stops)
    ]


class Progress:
    """A run with its clock, which can be saved.

    Attributes:
        spent: What the run has used so far.
        state: State of the search.
    """

    def __init__(self, protocol: Protocol, run: Run, out: Path, until: float) -> None:
        """Builds the search, compiles it, and restores the state, if there is one."""
        import newton_qd.compat
        from newton_qd.qd import EvolveConfig, make_task
        from newton_qd.qd.algorithms import algorithm_named
        from newton_qd.qd.run.search import Search

        if run.algorithm in ("pga-me", "dcrl-me"):
            newton_qd.compat.install()
        given = {**protocol.settings_of(run.task), **variants()[run.variant]}
        config = EvolveConfig(
            env_name=run.task,
            algorithm=run.algorithm,
            seed=run.seed,
            iterations=10**6,
            **given,
        )
        task = make_task(config)
        config = config.resolve(task.descriptor_length)
        self.run = run
        self.stops = list(protocol.stops_until(until))
        self.search = Search(config, task)
        spec = algorithm_named(run.algorithm)
        options = self.search.options
        self.gradients = spec.gradients(config, options) if spec.gradients else 0
        self.episode = config.episode_length
        self._path = out / "states" / f"{run}.bin"
        self._clock = out / "states" / f"{run}.json"
        self.spent = Spent()
        state = self.search.empty()
        for _ in range(3):  # compiles, and runs what is compiled
            state = self.search.advance(state)
        self.state = state
        self.scores()
        self.state = self.search.empty()
        if self._path.is_file() and self._clock.is_file():
            from newton_qd.qd.run.checkpoint import load_checkpoint

            self.state = self.search.restore(load_checkpoint(self._path))
            self.spent = Spent(**json.loads(self._clock.read_text()))

    def seconds(self, wall: bool) -> float:
        """Time of the run [s]."""
        return self.spent.wall_s if wall else self.spent.processor_s

    def save(self) -> None:
        """Writes state and clock."""
        from newton_qd.qd.run.checkpoint import save_checkpoint

        self._path.parent.mkdir(parents=True, exist_ok=True)
        save_checkpoint(self._path, self.search.checkpoint(self.state))
        self._clock.write_text(json.dumps(dataclasses.asdict(self.spent)))

    def forget(self) -> None:
        """Removes what ``save`` has written."""
        self._path.unlink(missing_ok=True)
        self._clock.unlink(missing_ok=True)

    def scores(self) -> tuple[dict[str, float], np.ndarray]:
        """Returns the columns of a line, and the fitnesses (2, cells) of the archive.

        The second row of the fitnesses is that of re-evaluated elites.
        """
        from newton_qd.qd.run import quality
        from newton_qd.qd.run.archive import Archive
        from newton_qd.qd.run.folder import COLUMNS

        row = dict(zip(COLUMNS, self.state.metrics[-1], strict=True))
        held = self.search.checkpoint(self.state)
        names = [field.name for field in dataclasses.fields(Archive)]
        archive = Archive(**{name: getattr(held, name) for name in names})
        found = self.search.corrected(archive)
        offset = self.search._generation.offset
        values = {
            "qd_score": quality.offset_qd_score(found, offset),
            "coverage": quality.coverage(found),
            "max_fitness": quality.best(found),
            "mean_fitness": quality.mean_fitness(found),
            "qd_gain": quality.qd_gain(found, row["initial_fitness"]),
        }
        column = COLUMNS.index("rejected")
        columns = {
            **row,
            "rejected": float(self.state.metrics[:, column].sum()),
            "gradient_steps": row["iteration"] * self.gradients * self.episode,
            **{f"corrected_{name}": float(x) for name, x in values.items()},
        }
        return columns, np.stack([archive.fitnesses, found]).astype(np.float32)


def execute(
    protocol: Protocol,
    run: Run,
    out: Path,
    *,
    until: float,
    device: str,
    deadline: float = math.inf,
) -> bool:
    """Carries a run out, or a part of it.

    Args:
        protocol: The protocol.
        run: The run.
        out: Folder of the runs.
        until: Longest time of a run [s].
        device: ``cpu``: times are those of the processor; ``cuda``: wall-clock times.
        deadline: ``time.monotonic()`` after which the run saves its state and ends.

    Returns:
        Whether the run has reached its last stop.
    """
    done = {
        line["stop"]
        for line in lines(out)
        if (line["protocol"], line["task"], line["variant"], line["seed"])
        == (protocol.name, run.task, run.variant, str(run.seed))
    }
    here = Progress(protocol, run, out, until)
    wall = device == "cuda"
    with turn(out) if wall else contextlib.nullcontext():
        return _to_the_end(protocol, here, done, out, until, device, deadline)


@contextlib.contextmanager
def turn(out: Path) -> Iterator[None]:
    """Waits until no other run of this GPU has its clock running.

    Other runs build and compile meanwhile.
    """
    gpu = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    with (out / f"gpu{gpu}.lock").open("w", encoding="utf-8") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _to_the_end(
    protocol: Protocol,
    here: Progress,
    done: set[str],
    out: Path,
    until: float,
    device: str,
    deadline: float,
) -> bool:
    """Advances a run past its stops that are not done, and writes a line at each."""
    wall = device == "cuda"
    left = [stop for stop in here.stops if str(stop) not in done]
    saved = here.seconds(wall)
    while left:
        begin = now()
        here.state = here.search.advance(here.state)
        here.spent.add(begin)
        evaluations = here.state.metrics[-1][1]
        seconds = here.seconds(wall)
        for stop in [x for x in left if x.reached(evaluations, seconds)]:
            left.remove(stop)
            _write(protocol, here, stop, device, out)
            here.save()
        if time.monotonic() > deadline and left:
            here.save()
            return False
        if seconds - saved > _SAVED_EVERY:
            here.save()
            saved = seconds
        if not any(x.unit == "s" for x in left) and seconds > until:
            break  # it will not reach the number of evaluations in time
    # a longer run may follow
    if len(here.stops) == len(protocol.stops):
        here.forget()
    return True


def _write(
    protocol: Protocol, here: Progress, stop: Stop, device: str, out: Path
) -> None:
    """Writes the scores at a stop."""
    columns, cells = here.scores()
    line = {
        "protocol": protocol.name,
        "task": here.run.task,
        "algorithm": here.run.algorithm,
        "variant": here.run.variant,
        "seed": here.run.seed,
        "stop": str(stop),
        "device": device,
        "commit": commit(),
        **dataclasses.asdict(here.spent),
        **columns,
    }
    path = out / "cells" / f"{here.run}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    kept = dict(np.load(path)) if path.is_file() else {}
    np.savez_compressed(path, **{**kept, str(stop): cells})
    add_line(out / "runs.csv", {name: _text(line[name]) for name in HEAD})


def _text(value: Any) -> str:
    return f"{value:.7g}" if isinstance(value, float) else str(value)


def add_line(path: Path, line: dict[str, str]) -> None:
    """Adds a line to a csv file that several processes write to."""
    with path.open("a", newline="", encoding="utf-8") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.seek(0, 2)
        writer = csv.DictWriter(file, HEAD, lineterminator="\n")
        if file.tell() == 0:
            writer.writeheader()
        writer.writerow(line)


def commit() -> str:
    """Returns the version of the code."""
    if "STUDY_COMMIT" in os.environ:  # a copy without the repository
        return os.environ["STUDY_COMMIT"]
    command = ["git", "describe", "--always", "--dirty"]
    folder = Path(__file__).parent
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, check=False
    )
    return done.stdout.strip() or "unknown"
