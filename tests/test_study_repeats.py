"""The report of runs that were made again."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path.insert(0, str(FOLDER))

import study_repeats  # noqa: E402
from study_runs import HEAD, TUNING_SEED  # noqa: E402

OURS, OTHER = "me-actor-critic@21", "dcrl-me@12"


def write(path: Path, *runs: tuple[str, int, float]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, HEAD, restval="1", lineterminator="\n")
        writer.writeheader()
        for variant, seed, score in runs:
            writer.writerow(
                {
                    **{"task": "hopper_uni", "variant": variant, "seed": seed},
                    **{"stop": "60 s", "corrected_qd_score": score},
                }
            )


@pytest.fixture
def runs(tmp_path: Path) -> study_repeats.Runs:
    ours = [(OURS, seed, 12.0) for seed in range(3)]
    other = [(OTHER, seed, 10.0) for seed in range(3)]
    write(tmp_path / "runs.csv", *ours, *other, (OTHER, TUNING_SEED, 99.0))
    write(tmp_path / "again.csv", (OURS, 0, 14.0), *((o, s, 12.0) for o, s, _ in other))
    return study_repeats.load(tmp_path, tmp_path / "again.csv", "60 s")


def test_the_reported_run_is_first(runs: study_repeats.Runs) -> None:
    assert study_repeats.again(runs).splitlines()[2:] == [
        f"| `hopper_uni`, `{OTHER}`, {seed} | 10 | 12 |" for seed in range(3)
    ] + [f"| `hopper_uni`, `{OURS}`, 0 | 12 | 14 |"]


def test_ratios_of_other_runs(runs: study_repeats.Runs) -> None:
    """Reported 12 / 10, at worst 12 / 12, and with means 37 / 33."""
    row = study_repeats.ratios(runs, "60 s").splitlines()[2]
    assert row == (
        f"| hopper_uni | {OURS} | {OTHER} | 1.20 (apart) | 1.00 (overlap) "
        "| 1.12 (apart) |"
    )


def test_without_the_chosen_variant_the_one_with_most_seeds_counts(
    runs: study_repeats.Runs,
) -> None:
    task = "hopper_uni"
    other = {
        (task, OTHER): runs[task, OTHER],
        (task, "me-actor-critic@11"): {0: [99.0]},
        (task, "me-actor-critic@13"): runs[task, OURS],
    }
    row = study_repeats.ratios(other, "60 s").splitlines()[2]
    assert row.startswith(f"| {task} | me-actor-critic@13 | {OTHER} | 1.20 (apart)")


def test_tasks_without_runs_made_again_are_left_out(
    runs: study_repeats.Runs,
) -> None:
    once = {
        key: {seed: scores[:1] for seed, scores in seeds.items()}
        for key, seeds in runs.items()
    }
    assert len(study_repeats.ratios(once, "60 s").splitlines()) == 2
    assert len(study_repeats.again(once).splitlines()) == 2


def test_an_unknown_stop_is_refused(tmp_path: Path, runs: study_repeats.Runs) -> None:
    with pytest.raises(ValueError, match=r"'61 s' has no runs.*'60 s'"):
        study_repeats.load(tmp_path, tmp_path / "again.csv", "61 s")
