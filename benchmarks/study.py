"""Compare gradient-based emitters with gradient-free ones on the environments.

Every run, of one task, algorithm and seed, has the same budget of seconds: processor
seconds on a CPU, which do not depend on what else the machine does, and wall-clock
seconds on a GPU. Compilation is left out: all functions run once on a state that is
thrown away before the clock starts. What evaluates the elites again, for corrected
metrics, runs after the clock has stopped.

A run is a process of its own and writes one csv file when it is finished; runs whose
file exists are left out, so that a study can be stopped and continued. Settings are in
``study/TASK.toml``.

    python benchmarks/study.py --seconds 60 --seeds 5 --workers 2 --out runs
    python benchmarks/study_report.py runs --out benchmarks/results/study.csv

With ``--workers N`` N runs go on at once, on a CPU each with its share of the cores, on
GPUs in turn on each of them.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import math
import os
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent / "study"
TASKS = (
    "ant_uni",
    "ant_omni",
    "halfcheetah_uni",
    "walker2d_uni",
    "hopper_uni",
    "anttrap",
    "pointmaze",
)
ALGORITHMS = ("me", "cma-me", "pga-me", "me-gradient", "cma-maega")
# Rows of a file: enough for a curve.
POINTS = 200


@dataclasses.dataclass(frozen=True)
class Run:
    """A run of the study."""

    task: str
    algorithm: str
    seed: int

    def file(self, folder: Path) -> Path:
        """Where its csv file is."""
        return folder / f"{self.task}.{self.algorithm}.{self.seed}.csv"


def config_of(run: Run) -> Any:
    """Settings of a run: those of the task, then those of the algorithm on it."""
    from newton_qd.qd import EvolveConfig

    with (FOLDER / f"{run.task}.toml").open("rb") as file:
        document = tomllib.load(file)
    given = {**document["settings"], **document.get(run.algorithm, {})}
    return EvolveConfig(
        env_name=run.task,
        algorithm=run.algorithm,
        seed=run.seed,
        iterations=10**6,
        **given,
    )


def curve(search: Any, gradients: int, seconds: float, wall: bool) -> Iterator[dict]:
    """Searches until the time is up, and yields what it has found on the way.

    Args:
        search: A ``Search``.
        gradients: Episodes of a generation that are differentiated.
        seconds: Budget [s].
        wall: Whether the budget is wall-clock time.
    """
    from newton_qd.qd.folder import COLUMNS

    state = search.empty()
    for _ in range(3):  # compiles, and runs what is compiled
        state = search.advance(state)
    state = search.empty()
    begin = time.perf_counter(), time.process_time()
    due, spent = 0.0, 0.0
    while spent < seconds:
        state = search.advance(state)
        wall_s = time.perf_counter() - begin[0]
        processor_s = time.process_time() - begin[1]
        spent = wall_s if wall else processor_s
        if spent >= due or spent >= seconds:
            due = spent + seconds / POINTS
            row = dict(zip(COLUMNS, state.metrics[-1], strict=True))
            each = row["env_steps"] / row["evaluations"]
            yield {
                "wall_s": wall_s,
                "processor_s": processor_s,
                **row,
                "gradient_steps": row["iteration"] * gradients * each,
                "rejected": state.metrics[:, COLUMNS.index("rejected")].sum(),
                "state": state,
            }


def execute(run: Run, seconds: float, device: str, out: Path) -> None:
    """Carries out a run and writes its file."""
    import newton_qd.compat
    from newton_qd.qd import make_task
    from newton_qd.qd.algorithms import ALGORITHMS as TABLE
    from newton_qd.qd.folder import Archive
    from newton_qd.qd.search import Search

    if run.algorithm == "pga-me":
        newton_qd.compat.install()
    config = config_of(run)
    task = make_task(config)
    config = config.resolve(task.descriptor_length)
    search = Search(config, task)
    gradients = TABLE[run.algorithm].gradients(config)
    rows: list[dict] = []
    state: Any = None
    for row in curve(search, gradients, seconds, device == "cuda"):
        state = row.pop("state")
        rows.append(row)
    held = search.checkpoint(state)
    names = [field.name for field in dataclasses.fields(Archive)]
    archive = Archive(**{name: getattr(held, name) for name in names})
    corrected = search.correct(archive)
    empty = dict.fromkeys(("qd_score", "coverage", "max_fitness"), math.nan)
    for row in rows:
        values = vars(corrected) if corrected and row is rows[-1] else empty
        row.update({f"corrected_{name}": values[name] for name in empty})
    write(run.file(out), rows)


def write(path: Path, rows: list[dict]) -> None:
    """Writes a csv file that is whole if it exists."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".unfinished")
    with unfinished.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({name: f"{value:.9g}" for name, value in row.items()})
    unfinished.replace(path)


@dataclasses.dataclass
class Pool:
    """Processes, one in each slot.

    Attributes:
        args: Arguments of the command.
        slots: The process of each slot, or ``None``.
        gpus: Number of GPUs.
    """

    args: argparse.Namespace
    slots: list[subprocess.Popen | None]
    gpus: int

    def free(self) -> int | None:
        """A slot whose process has ended; says so if it has failed."""
        for slot, process in enumerate(self.slots):
            if process is None or process.poll() is not None:
                if process is not None and process.returncode:
                    print(f"failed: {process.args}", file=sys.stderr, flush=True)
                self.slots[slot] = None
                return slot
        return None

    def start(self, slot: int, *what: str) -> None:
        """Starts this file again with other arguments."""
        args = self.args
        common = ["--seconds", str(args.seconds), "--device", args.device]
        command = [sys.executable, __file__, *common, "--out", str(args.out), *what]
        variables = {**os.environ, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
        if args.device == "cuda":
            variables["CUDA_VISIBLE_DEVICES"] = str(slot % self.gpus)
        else:
            variables["JAX_PLATFORMS"] = "cpu"
            cores = sorted(os.sched_getaffinity(0))
            share = cores[slot % len(cores) :: len(self.slots)]
            command += ["--cores", *map(str, share)]
        self.slots[slot] = subprocess.Popen(command, env=variables)

    def wait(self) -> int:
        """Waits for a free slot."""
        while (slot := self.free()) is None:
            time.sleep(0.2)
        return slot

    def drain(self) -> None:
        """Waits for all processes."""
        for process in self.slots:
            if process is not None:
                process.wait()
        while any(self.slots):
            self.free()


def arguments() -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs"))
    parser.add_argument("--tasks", nargs="*", choices=TASKS, default=list(TASKS))
    parser.add_argument("--algorithms", nargs="*", default=list(ALGORITHMS))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--gpus", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument(
        "--start-until",
        type=float,
        default=math.inf,
        help="start no run later than so many seconds after the command",
    )
    parser.add_argument("--cores", type=int, nargs="*", help=argparse.SUPPRESS)
    parser.add_argument("--run", nargs=3, help=argparse.SUPPRESS)
    return parser.parse_args()


def main() -> None:
    """Runs what is missing."""
    begin, args = time.monotonic(), arguments()
    if args.cores:
        os.sched_setaffinity(0, args.cores)
    if args.run:
        task, algorithm, seed = args.run
        execute(Run(task, algorithm, int(seed)), args.seconds, args.device, args.out)
        return
    # Seeds first, so that a study that was stopped has all tasks and algorithms.
    runs = [
        Run(task, algorithm, seed)
        for seed in range(args.seeds)
        for task in args.tasks
        for algorithm in args.algorithms
    ]
    missing = [run for run in runs if not run.file(args.out).exists()]
    pool = Pool(args, [None] * args.workers, args.gpus)
    for number, run in enumerate(missing):
        slot = pool.wait()
        spent = time.monotonic() - begin
        if spent > args.start_until:
            print(f"{len(missing) - number} runs are left", flush=True)
            break
        print(f"{spent:5.0f} s: {run}, {number + 1} of {len(missing)}", flush=True)
        pool.start(slot, "--run", run.task, run.algorithm, str(run.seed))
    pool.drain()


if __name__ == "__main__":
    main()
