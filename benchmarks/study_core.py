"""The protocol ``core`` of the study: one core of a CPU, one csv file for each run.

Settings of its tasks are in ``study/TASK.toml``, those of algorithms in
``study/variants.toml``.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import itertools
import math
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import study_runs
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


def algorithms() -> list[str]:
    """Algorithms that have a variant."""
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
