"""Carries out runs of a protocol: stopped, continued, and written line by line.

A run adds one line to ``runs.csv`` at each of its stops, and the fitness of each cell
to ``cells/RUN.npz``. Scores of re-evaluated elites are part of the line; for them, the
clock is stopped. A run that is stopped leaves ``states/RUN.bin``, from which the next
command continues; it is removed when the run has reached its last stop.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import json
import math
import os
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from study_protocols import Protocol, Stop
from study_runs import HEAD, Run, add_line, lines, variants

_SAVED_EVERY = 60.0  # seconds of a run between two copies of its state


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


@dataclasses.dataclass(frozen=True)
class Limits:
    """When a run ends.

    Attributes:
        until: Longest time of the run [s].
        reach: Whether it goes on after that until it has its number of evaluations.
        deadline: ``time.monotonic()`` after which the run saves its state and ends.
    """

    until: float
    reach: bool = False
    deadline: float = math.inf


def now() -> tuple[float, float]:
    """Returns wall-clock and processor time [s]."""
    return time.perf_counter(), time.process_time()


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
    limits: Limits,
    device: str,
) -> bool:
    """Carries a run out, or a part of it.

    Args:
        protocol: The protocol.
        run: The run.
        out: Folder of the runs.
        limits: When the run ends.
        device: ``cpu``: times are those of the processor; ``cuda``: wall-clock times.

    Returns:
        Whether the run has reached its last stop.
    """
    done = {
        line["stop"]
        for line in lines(out)
        if (line["protocol"], line["task"], line["variant"], line["seed"])
        == (protocol.name, run.task, run.variant, str(run.seed))
    }
    wall = device == "cuda"
    with _gpu(out, fcntl.LOCK_SH) if wall else contextlib.nullcontext():
        here = Progress(protocol, run, out, limits.until)
    with _gpu(out, fcntl.LOCK_EX) if wall else contextlib.nullcontext():
        return _to_the_end(protocol, here, done, out, limits, device)


@contextlib.contextmanager
def _gpu(out: Path, kind: int) -> Iterator[None]:
    """Waits until this process may use its GPU.

    Several runs compile and warm up at once, with ``LOCK_SH``. A run whose clock is
    running has the GPU and the cores of the machine for itself, with ``LOCK_EX``.
    """
    gpu = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    with (out / f"gpu{gpu}.lock").open("w", encoding="utf-8") as file:
        fcntl.flock(file, kind)
        yield


def _to_the_end(
    protocol: Protocol,
    here: Progress,
    done: set[str],
    out: Path,
    limits: Limits,
    device: str,
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
        if time.monotonic() > limits.deadline and left:
            here.save()
            return False
        if seconds - saved > _SAVED_EVERY:
            here.save()
            saved = seconds
        late = seconds > limits.until and not any(x.unit == "s" for x in left)
        if late and not limits.reach:
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
