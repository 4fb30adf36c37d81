"""Lines of runs of the study that never ran."""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import Any

import numpy as np

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path.insert(0, str(FOLDER))

import study_runs  # noqa: E402

TASK, CELLS = "hopper_uni", 8


def line(algorithm: str, seed: int, stop: str, **values: Any) -> dict[str, str]:
    given = {
        **dict.fromkeys(study_runs.HEAD, 1.0),
        **{"protocol": "small", "task": TASK, "algorithm": algorithm, "seed": seed},
        **{"variant": f"{algorithm}@0", "stop": stop, "device": "cpu"},
        **{"initial_fitness": 2.0, **values},
    }
    return {name: str(given[name]) for name in study_runs.HEAD}


def write(path: Path, *rows: dict[str, Any]) -> None:
    """Writes a file of runs; what a row leaves out is 1."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, study_runs.HEAD, restval="1", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def scored(variant: str, seed: int, score: float, **values: Any) -> dict[str, Any]:
    """Returns the row of a run, after 60 s if there is no other stop."""
    return {
        **{"task": TASK, "algorithm": variant.partition("@")[0], "variant": variant},
        **{"seed": seed, "stop": "60 s", "corrected_qd_score": score, **values},
    }


def add(out: Path, algorithm: str, seed: int, stop: str, fitnesses: Any) -> None:
    """Adds a run whose re-evaluated elites lose 1."""
    raw = np.asarray(fitnesses, np.float32)
    (out / "cells").mkdir(exist_ok=True)
    path = out / "cells" / f"{TASK}.{algorithm}@0.{seed}.npz"
    cells: dict[str, Any] = {stop: np.stack([raw, raw - 1])}
    np.savez(path, **cells)
    score = float(np.sum(raw[np.isfinite(raw)] + 9))
    row = line(algorithm, seed, stop, corrected_qd_score=score)
    study_runs.add_line(out / "runs.csv", row)
