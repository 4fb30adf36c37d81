"""Compare gradient-based emitters with gradient-free ones on the environments.

Every run, of one task, algorithm and seed, has the same budget of seconds: processor
seconds on a CPU, which depend on what else the machine does only as far as cores share
caches and memory, and wall-clock seconds on a GPU. Compilation is left out: all
functions run once on a state that is thrown away before the clock starts. What
evaluates the elites again, for metrics without luck, runs after the clock has stopped.

A run is a process of its own and writes one csv file when it is finished; runs whose
file exists are left out, so that a study can be stopped and continued. Settings of
tasks are in ``study/TASK.toml``, those of algorithms in ``study/variants.toml``. Which
variant is best on a task is found first, with another seed:

    python benchmarks/study.py --tune --seconds 20 --workers 2 --out tuning
    python benchmarks/study.py --tuned tuning --seconds 60 --workers 2 --out runs
    python benchmarks/study_report.py runs --out benchmarks/results/study.csv

With ``--workers N`` N runs go on at once, on a CPU each with its share of the cores, on
GPUs in turn on each of them. Runs of a protocol below that share a GPU compile and warm
up together, and then take turns: while one has its clock running, the others wait.

All this is the protocol ``core``, for one core of a CPU. ``study_protocols.py`` has two
more. ``field`` is that of published comparisons, for one GPU: a million evaluations in
batches of 1,024, and scores after 60, 250 and 1,000 s. ``small`` has the same policies,
episodes and cells, for minutes on a CPU. Their runs can be stopped at any time and
continued, see ``study_execution.py``; variants are in ``study/field.toml``:

    python benchmarks/study.py --protocol field --device cuda --until 60 --out field
    python benchmarks/study.py --protocol small --out small
    python benchmarks/study_scores.py small

``--until S`` leaves later stops for another command, which continues the runs.
``--stop-after S`` ends the command in time for a machine that is lent for so long.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import itertools
import math
import os
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import study_execution
import study_runs
from study_pool import Pool
from study_protocols import PROTOCOLS
from study_runs import TUNING_SEED

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
ALGORITHMS = (
    "me",
    "cma-me",
    "pga-me",
    "me-gradient",
    "cma-maega",
    "me-actor-critic",
)
# Rows of a file: enough for a curve.
POINTS = 200


class Run(study_runs.Run):
    """A run of the study, whose settings are in ``variants.toml``."""

    def file(self, folder: Path, name: str) -> Path:
        """Where its csv file is, under the name of its variant or algorithm."""
        return folder / f"{self.task}.{name}.{self.seed}.csv"


def read(name: str) -> dict[str, Any]:
    """Reads a file of settings."""
    with (FOLDER / f"{name}.toml").open("rb") as file:
        return tomllib.load(file)


def config_of(run: Run) -> Any:
    """Settings of a run: those of the task and those of the variant."""
    from newton_qd.qd import EvolveConfig

    given = {**read(run.task), **read("variants")[run.variant]}
    return EvolveConfig(
        env_name=run.task,
        algorithm=run.algorithm,
        seed=run.seed,
        iterations=10**6,
        **given,
    )


def best_variant(tuning: Path, task: str, algorithm: str) -> str:
    """The variant with the highest final QD score.

    Raises:
        FileNotFoundError: None was tried.
    """
    scores = {}
    for path in tuning.glob(f"{task}.{algorithm}@*.csv"):
        with path.open(newline="", encoding="utf-8") as file:
            *_, last = csv.DictReader(file)
        scores[path.name.split(".")[1]] = float(last["qd_score"])
    if not scores:
        raise FileNotFoundError(f"{tuning} holds no run of {algorithm} on {task}")
    return max(scores, key=lambda name: scores[name])


def curve(search: Any, gradients: int, seconds: float, wall: bool) -> Iterator[dict]:
    """Searches until the time is up, and yields what it has found on the way.

    Args:
        search: A ``Search``.
        gradients: Episodes of a generation that are differentiated.
        seconds: Budget [s].
        wall: Whether the budget is wall-clock time.
    """
    from newton_qd.qd.run.folder import COLUMNS

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


def execute(run: Run, seconds: float, device: str, file: Path) -> None:
    """Carries out a run and writes its file."""
    import newton_qd.compat
    from newton_qd.qd import make_task
    from newton_qd.qd.algorithms import algorithm_named
    from newton_qd.qd.run.archive import Archive
    from newton_qd.qd.run.search import Search

    if run.algorithm == "pga-me":
        newton_qd.compat.install()
    config = config_of(run)
    task = make_task(config)
    config = config.resolve(task.descriptor_length)
    search = Search(config, task)
    spec = algorithm_named(run.algorithm)
    gradients = spec.gradients(config, search.options) if spec.gradients else 0
    rows: list[dict] = []
    state: Any = None
    for row in curve(search, gradients, seconds, device == "cuda"):
        state = row.pop("state")
        rows.append(row)
    held = search.checkpoint(state)
    names = [field.name for field in dataclasses.fields(Archive)]
    archive = Archive(**{name: getattr(held, name) for name in names})
    again = search.reevaluate(archive)
    empty = dict.fromkeys(("qd_score", "coverage", "max_fitness"), math.nan)
    for row in rows:
        values = vars(again) if again and row is rows[-1] else empty
        row.update({f"corrected_{name}": values[name] for name in empty})
    write(file, rows)


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


def arguments() -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--protocol", choices=("core", *PROTOCOLS), default="core")
    parser.add_argument("--out", type=Path, default=Path("runs"))
    parser.add_argument("--tasks", nargs="*", help="default: all of the protocol")
    parser.add_argument("--algorithms", nargs="*", help="default: all of the protocol")
    parser.add_argument(
        "--seeds", type=int, help="at most so many; default: 5, or as the protocol says"
    )
    parser.add_argument(
        "--variants", nargs="*", help="field, small: run these, as for ablations"
    )
    parser.add_argument(
        "--until", type=float, help="field, small: longest time of a run [s]"
    )
    parser.add_argument(
        "--stop-after",
        type=float,
        default=math.inf,
        help="field, small: stop all runs so many seconds after the command",
    )
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
    parser.add_argument(
        "--tune", action="store_true", help="run every variant, with a seed of its own"
    )
    parser.add_argument("--tuned", type=Path, help="folder of what --tune has found")
    parser.add_argument("--cores", type=int, nargs="*", help=argparse.SUPPRESS)
    parser.add_argument("--run", nargs=4, help=argparse.SUPPRESS)
    return checked(parser, parser.parse_args())


def checked(
    parser: argparse.ArgumentParser, args: argparse.Namespace
) -> argparse.Namespace:
    """Fills in the protocol's defaults, and ends the command at an unknown name."""
    protocol = PROTOCOLS.get(args.protocol)
    args.tasks = args.tasks or list(protocol.tasks if protocol else TASKS)
    args.algorithms = args.algorithms or list(
        protocol.algorithms if protocol else ALGORITHMS
    )
    known = {
        "tasks": protocol.tasks if protocol else TASKS,
        "algorithms": protocol.algorithms if protocol else _core_algorithms(),
    }
    for name, allowed in known.items():
        unknown = sorted(set(getattr(args, name)) - set(allowed))
        if unknown:
            parser.error(
                f"--{name}: got {', '.join(unknown)}; allowed: {', '.join(allowed)}"
            )
    unknown = sorted(set(args.variants or ()) - set(study_runs.variants()))
    if protocol and unknown:
        allowed = ", ".join(study_runs.variants())
        parser.error(f"--variants: got {', '.join(unknown)}; allowed: {allowed}")
    if args.seeds is None:
        args.seeds = protocol.seeds if protocol else 5
    if args.until is None:
        stops = protocol.stops if protocol else ()
        args.until = max((x.amount for x in stops if x.unit == "s"), default=math.inf)
    for name in ("seeds", "gpus", "workers"):
        value = getattr(args, name)
        if value < 1:
            parser.error(f"--{name}: got {value}; allowed: an integer from 1")
    for name in ("seconds", "until", "stop_after", "start_until"):
        value = getattr(args, name)
        if not value > 0:
            option = name.replace("_", "-")
            parser.error(f"--{option}: got {value}; allowed: a number above 0")
    return args


def _core_algorithms() -> list[str]:
    """Algorithms that have a variant in the protocol ``core``."""
    return list(dict.fromkeys(name.split("@")[0] for name in read("variants")))


def planned(args: argparse.Namespace) -> list[tuple[Run, Path]]:
    """Runs and their files.

    Seeds come first, so that a study that was stopped has all tasks and algorithms.
    """
    kinds = list(itertools.product(args.tasks, args.algorithms))
    if args.tune:
        variants = read("variants")
        runs = [
            Run(task, variant, TUNING_SEED)
            for task, algorithm in kinds
            for variant in variants
            if variant.split("@")[0] == algorithm
        ]
        return [(run, run.file(args.out, run.variant)) for run in runs]
    chosen = {
        kind: best_variant(args.tuned, *kind) if args.tuned else f"{kind[1]}@1"
        for kind in kinds
    }
    runs = [
        Run(task, variant, seed)
        for seed in range(args.seeds)
        for (task, _), variant in chosen.items()
    ]
    return [(run, run.file(args.out, run.algorithm)) for run in runs]


def left(args: argparse.Namespace) -> list[tuple[str, ...]]:
    """Task, variant, seed and output of the runs that are not finished."""
    if args.protocol == "core":
        return [
            (run.task, run.variant, str(run.seed), str(file))
            for run, file in planned(args)
            if not file.exists()
        ]
    choice = study_runs.Choice(
        tasks=args.tasks,
        algorithms=args.algorithms,
        seeds=args.seeds,
        until=args.until,
        tune=args.tune,
        tuned=args.tuned,
        variants=args.variants,
    )
    found = study_runs.missing(PROTOCOLS[args.protocol], args.out, choice)
    return [(run.task, run.variant, str(run.seed), str(args.out)) for run in found]


def one(args: argparse.Namespace, begin: float) -> None:
    """Carries out one run."""
    task, variant, seed, out = args.run
    if args.protocol == "core":
        run = Run(task, variant, int(seed))
        execute(run, args.seconds, args.device, Path(out))
        return
    study_execution.execute(
        PROTOCOLS[args.protocol],
        study_runs.Run(task, variant, int(seed)),
        Path(out),
        until=args.until,
        device=args.device,
        deadline=begin + args.stop_after,
    )


def main() -> None:
    """Runs what is missing."""
    begin, args = time.monotonic(), arguments()
    if args.cores:
        os.sched_setaffinity(0, args.cores)
    if args.run:
        one(args, begin)
        return
    args.out.mkdir(parents=True, exist_ok=True)
    missing = left(args)
    latest = min(args.start_until, args.stop_after)
    pool = Pool(args, [None] * args.workers, args.gpus)
    for number, what in enumerate(missing):
        slot = pool.wait()
        spent = time.monotonic() - begin
        if spent > latest:
            print(f"{len(missing) - number} runs are left", flush=True)
            break
        print(f"{spent:5.0f} s: {what}, {number + 1} of {len(missing)}", flush=True)
        more = []
        if args.protocol != "core":
            more = ["--until", str(args.until)]
            more += ["--stop-after", str(args.stop_after - spent)]
        pool.start(slot, *more, "--run", *what)
    pool.drain()


if __name__ == "__main__":
    main()
