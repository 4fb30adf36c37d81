"""Carries out runs of a protocol: stopped, continued, and written line by line.

A run adds one line to ``runs.csv`` at each of its stops, and the fitness of each cell
to ``cells/RUN.npz``. Scores of re-evaluated elites are part of the line; for them, the
clock is stopped. A run that is stopped leaves its state and clock in one file,
``states/RUN.state``, from which the next command continues; it is removed when the run
has reached its last stop. Clocks are explained in ``study_clock.py``.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import study_clock
from study_clock import Spent
from study_protocols import Protocol, Stop
from study_runs import HEAD, Run, add_line, lines, variants

_SAVED_EVERY = 60.0  # seconds of a run between two copies of its state


@dataclasses.dataclass(frozen=True)
class Limits:
    """When a run ends.

    Attributes:
        until: Longest time of the run [s].
        reach: Whether it goes on after that until it has its number of evaluations.
        deadline: ``time.monotonic()`` after which the run saves its state and ends.
        paced: Whether runs share a GPU, with generations as their clock.
        states: Whether the state is saved. DCRL-ME has gigabytes of it, and a run
            stands still meanwhile.
    """

    until: float
    reach: bool = False
    deadline: float = math.inf
    paced: bool = False
    states: bool = True


class Progress:
    """A run with its clock, which can be saved.

    Attributes:
        spent: What the run has used so far.
        state: State of the search.
        pace: Time that a generation adds to the clock [s]; ``None``: what it took.
    """

    pace: float | None = None

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
        self._path = out / "states" / f"{run}.state"
        # an earlier version had the state and its clock in two files
        self._earlier = [out / "states" / f"{run}.{x}" for x in ("bin", "json")]
        self.spent = Spent()
        self.state = self.search.empty()
        for _ in range(3):  # compiles, and runs what is compiled
            self.advance()
        self.scores()
        self.spent, self.state = Spent(), self.search.empty()
        self._restore()

    def seconds(self, wall: bool) -> float:
        """Time of the run [s]."""
        return self.spent.wall_s if wall else self.spent.processor_s

    def advance(self) -> None:
        """Runs one generation, and adds its time."""
        begin = study_clock.now()
        self.state = self.search.advance(self.state)
        self.spent.add(begin, self.pace)

    def find_pace(self, out: Path) -> None:
        """Finds the time of a generation that has a GPU for itself.

        If it must be measured, this takes some first generations, and forgets them.
        """
        import jax

        state, spent = self.state, dataclasses.replace(self.spent)
        gpu = jax.devices()[0].device_kind
        later = getattr(self.search.options, "episodes_after", 0)
        self.pace = study_clock.pace(
            out, self.run, self.advance, gpu, commit(), later=later
        )
        self.state, self.spent = state, spent

    def _restore(self) -> None:
        """Restores state and clock, if there are any."""
        from newton_qd.qd.run.checkpoint import load_checkpoint

        state, clock = self._earlier
        if self._path.is_file():
            held = load_checkpoint(self._path)
            *emitter, spent = held.emitter
            held = dataclasses.replace(held, emitter=tuple(emitter))
            self.spent = Spent(*spent.tolist())
        elif state.is_file() and clock.is_file():
            held = load_checkpoint(state)
            self.spent = Spent(**json.loads(clock.read_text()))
        else:
            return
        self.state = self.search.restore(held)

    def save(self) -> None:
        """Writes state and clock."""
        from newton_qd.qd.run.checkpoint import save_checkpoint

        self._path.parent.mkdir(parents=True, exist_ok=True)
        held = self.search.checkpoint(self.state)
        # beside the arrays of the emitter: two files would not be written at once
        spent = np.array(dataclasses.astuple(self.spent))
        held = dataclasses.replace(held, emitter=(*held.emitter, spent))
        save_checkpoint(self._path, held)
        self._forget_earlier()

    def forget(self) -> None:
        """Removes what ``save`` has written."""
        self._path.unlink(missing_ok=True)
        self._forget_earlier()

    def _forget_earlier(self) -> None:
        for path in self._earlier:
            path.unlink(missing_ok=True)

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
        device: ``cpu``: times are those of the processor; ``cuda``: wall-clock times,
            or those of ``study_clock.pace``.

    Returns:
        Whether the run has reached its last stop.
    """
    done = {
        line["stop"]
        for line in lines(out)
        if (line["protocol"], line["task"], line["variant"], line["seed"])
        == (protocol.name, run.task, run.variant, str(run.seed))
    }
    if device == "cpu":
        here = Progress(protocol, run, out, limits.until)
        return _to_the_end(protocol, here, done, out, limits, "processor")
    with study_clock.shared():
        here = Progress(protocol, run, out, limits.until)
    if limits.paced:
        here.find_pace(out)
        return _to_the_end(protocol, here, done, out, limits, "paced")
    with study_clock.alone():
        return _to_the_end(protocol, here, done, out, limits, "wall")


def _to_the_end(
    protocol: Protocol,
    here: Progress,
    done: set[str],
    out: Path,
    limits: Limits,
    clock: str,
) -> bool:
    """Advances a run past its stops that are not done, and writes a line at each."""
    wall = clock != "processor"
    save = here.save if limits.states else lambda: None
    # a state may come from another folder, which has the lines of its stops
    passed = _reached(here, wall)
    left = [stop for stop in here.stops if str(stop) not in {*done, *passed}]
    saved = here.seconds(wall)

    def shared() -> contextlib.AbstractContextManager[None]:
        """While the pace of another run is measured, this one does nothing."""
        return study_clock.shared() if clock == "paced" else contextlib.nullcontext()

    while left:
        with shared():
            here.advance()
        seconds = here.seconds(wall)
        reached = _reached(here, wall)
        for stop in [x for x in left if str(x) in reached]:
            left.remove(stop)
            with shared():
                _write(protocol, here, stop, clock, out)
                save()
        if time.monotonic() > limits.deadline and left:
            with shared():
                save()
            return False
        if seconds - saved > _SAVED_EVERY:
            with shared():
                save()
            saved = seconds
        late = seconds > limits.until and not any(x.unit == "s" for x in left)
        if late and not limits.reach:
            break  # it will not reach the number of evaluations in time
    # a longer run may follow
    if len(here.stops) == len(protocol.stops):
        here.forget()
    return True


def _reached(here: Progress, wall: bool) -> set[str]:
    """Returns the stops that a run has reached."""
    if not len(here.state.metrics):
        return set()
    evaluations, seconds = here.state.metrics[-1][1], here.seconds(wall)
    return {str(stop) for stop in here.stops if stop.reached(evaluations, seconds)}


def _write(
    protocol: Protocol, here: Progress, stop: Stop, clock: str, out: Path
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
        "device": "cpu" if clock == "processor" else "cuda",
        "clock": clock,
        "commit": commit(),
        **dataclasses.asdict(here.spent),
        **columns,
    }
    path = out / "cells" / f"{here.run}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    kept = dict(np.load(path)) if path.is_file() else {}
    # a run may be stopped at any time; NumPy adds .npz to another name
    unfinished = path.with_suffix(".unfinished.npz")
    np.savez_compressed(unfinished, **{**kept, str(stop): cells})
    unfinished.replace(path)
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
