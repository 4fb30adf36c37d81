"""Clocks of the runs of a protocol, and who may use a GPU meanwhile.

On a CPU, the clock of a run is the time of its processor. On a GPU it is wall-clock
time, and the run has the GPU for itself. That wastes most of the GPU: a generation of a
thousand worlds is a chain of small kernels, which fill a small part of it. So a run can
be paced instead. Some generations are timed with the GPU for themselves. After that,
the clock is the number of generations times this time, and many runs share the GPU.
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import fcntl
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from study_runs import Run, add_line

PACES = "paces.csv"
HEAD = ("task", "variant", "gpu", "commit", "generations", "generation_s")
LEAST_SECONDS = 5.0  # of a measured pace
LEAST_GENERATIONS = 5


@dataclasses.dataclass
class Spent:
    """What a run has used so far, without compilation and re-evaluations.

    Attributes:
        wall_s: Wall-clock time [s].
        processor_s: Time of all processor cores [s].
    """

    wall_s: float = 0.0
    processor_s: float = 0.0

    def add(self, begin: tuple[float, float], pace: float | None = None) -> None:
        """Adds a generation.

        Args:
            begin: What ``now`` returned before the generation.
            pace: Wall-clock time [s] to add; ``None``: the time since ``begin``.
        """
        wall, processor = now()
        self.wall_s += wall - begin[0] if pace is None else pace
        self.processor_s += processor - begin[1]


def now() -> tuple[float, float]:
    """Returns wall-clock and processor time [s]."""
    return time.perf_counter(), time.process_time()


@contextlib.contextmanager
def shared() -> Iterator[None]:
    """Waits until no run needs the GPU for itself; others may use it meanwhile."""
    with _held("turn", fcntl.LOCK_SH):
        pass
    with _held("lock", fcntl.LOCK_SH):
        yield


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """Waits until no other run uses the GPU, also one of another folder of runs.

    Runs that ask for the GPU later wait, so its turn comes. Those on other GPUs go on.
    """
    with _held("turn", fcntl.LOCK_EX), _held("lock", fcntl.LOCK_EX):
        yield


@contextlib.contextmanager
def _held(name: str, kind: int) -> Iterator[None]:
    """Holds a lock of the GPU, whose file is the same for all commands of a user."""
    gpu = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    path = Path(tempfile.gettempdir()) / f"newton_qd-{os.getuid()}-gpu{gpu}.{name}"
    with path.open("w", encoding="utf-8") as file:
        fcntl.flock(file, kind)
        yield


def known_pace(out: Path, run: Run) -> float | None:
    """Returns the time [s] of a generation of a run's variant, if it was measured."""
    path = out / PACES
    if not path.is_file():
        return None
    with path.open(newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            if (line["task"], line["variant"]) == (run.task, run.variant):
                return float(line["generation_s"])
    return None


def _timed(generation: Callable[[], object]) -> list[float]:
    """Returns the times [s] of some generations."""
    times: list[float] = []
    while len(times) < LEAST_GENERATIONS or sum(times) < LEAST_SECONDS:
        begin = time.perf_counter()
        generation()
        times.append(time.perf_counter() - begin)
    return times


def pace(
    out: Path,
    run: Run,
    generation: Callable[[], object],
    gpu: str,
    commit: str,
    *,
    later: int = 0,
) -> float:
    """Returns the median time [s] of a generation on a GPU of its own.

    Args:
        out: Folder of the runs. Its ``paces.csv`` has the time of each task and
            variant; the first run of a variant measures it. Where runs of two GPUs
            measure it at the same time, the one that ends first counts for both.
        run: The run.
        generation: Runs the next generation, compiled, and waits for its end. The first
            one, which evaluates the initial population, is not timed.
        gpu: Name of the GPU.
        commit: Version of the code.
        later: Generations after which a generation does something else, or 0. Then both
            kinds are timed, and the slower one counts.
    """
    found = known_pace(out, run)
    if found is not None:
        return found
    with alone():
        found = known_pace(out, run)  # of another seed that was faster
        if found is not None:
            return found
        generation()
        times = _timed(generation)
        found = statistics.median(times)
        if later:
            for _ in range(later - 1 - len(times)):
                generation()
            found = max(found, statistics.median(_timed(generation)))
        earlier = known_pace(out, run)  # of another GPU, meanwhile
        if earlier is not None:
            return earlier
        line = (run.task, run.variant, gpu, commit, str(len(times)), f"{found:.7g}")
        add_line(out / PACES, dict(zip(HEAD, line, strict=True)), HEAD)
    return found
