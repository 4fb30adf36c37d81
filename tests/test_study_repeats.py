"""The report of runs that were made again."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path.insert(0, str(FOLDER))

import study_helpers  # noqa: E402
import study_repeats  # noqa: E402
from study_runs import TUNING_SEED  # noqa: E402

OURS, OTHER = "me-actor-critic@21", "dcrl-me@12"
Loaded = tuple[study_repeats.Runs, set[tuple[str, str]]]


def write(path: Path, *runs: tuple[str, int, float]) -> None:
    study_helpers.write(path, *(study_helpers.scored(*run) for run in runs))


@pytest.fixture
def loaded(tmp_path: Path) -> Loaded:
    ours = [(OURS, seed, 12.0) for seed in range(3)]
    other = [(OTHER, seed, 10.0) for seed in range(3)]
    write(tmp_path / "runs.csv", *ours, *other, (OTHER, TUNING_SEED, 99.0))
    again = [(OTHER, seed, 12.0) for seed in (*range(3), TUNING_SEED)]
    write(tmp_path / "again.csv", (OURS, 0, 14.0), *again)
    return study_repeats.load(tmp_path, tmp_path / "again.csv", "60 s")


def test_the_reported_run_is_first(loaded: Loaded) -> None:
    assert loaded[0]["hopper_uni", OURS] == {0: [12.0, 14.0], 1: [12.0], 2: [12.0]}


def test_seeds_that_ran_once_are_not_counted(loaded: Loaded) -> None:
    sentence, table = study_repeats.again(loaded[0])
    assert sentence == "Of 4 groups of equal runs, 0 differ by less than 15 %."
    assert table.splitlines()[2:] == [
        f"| hopper_uni | {OTHER} | 2, 2, 2 | 1.20, 1.20, 1.20 |",
        f"| hopper_uni | {OURS} | 2 | 1.17 |",
    ]


def test_ratios_of_other_runs(loaded: Loaded) -> None:
    """Reported 12 / 10, at worst 12 / 12, and with means 37 / 33."""
    row = study_repeats.ratios(*loaded).splitlines()[2]
    assert row == (
        f"| hopper_uni | {OURS} | {OTHER} | 1.20 (apart) | 1.00 (overlap) "
        "| 1.12 (apart) |"
    )


def test_only_our_chosen_variant_is_compared(tmp_path: Path) -> None:
    """Another one of ours does not count, however good, nor an ablation of others."""
    names = ("me-actor-critic@11", "dcrl-me@cut")
    better = [(name, seed, 99.0) for name in names for seed in range(3)]
    ours = [(OURS, seed, 12.0) for seed in range(3)]
    write(tmp_path / "runs.csv", *better, *ours, (OTHER, 0, 10.0))
    write(tmp_path / "again.csv", (OURS, 0, 14.0))
    loaded = study_repeats.load(tmp_path, tmp_path / "again.csv", "60 s")
    row = study_repeats.ratios(*loaded).splitlines()[2]
    assert row.startswith(f"| hopper_uni | {OURS} | {OTHER} | 1.20 (too few seeds)")


def test_tasks_without_runs_made_again_are_left_out(loaded: Loaded) -> None:
    runs, named = loaded
    once = {
        key: {seed: scores[:1] for seed, scores in seeds.items()}
        for key, seeds in runs.items()
    }
    assert len(study_repeats.ratios(once, named).splitlines()) == 2
    assert len(study_repeats.again(once)[1].splitlines()) == 2


@pytest.mark.usefixtures("loaded")
def test_an_unknown_stop_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"'61 s' has no runs.*'60 s'"):
        study_repeats.load(tmp_path, tmp_path / "again.csv", "61 s")


def test_enough_seeds_count_first(tmp_path: Path) -> None:
    one = ("me@1", 0, 99.0)
    runs = [(name, seed, 12.0) for name in (OURS, OTHER) for seed in range(3)]
    write(tmp_path / "runs.csv", one, *runs)
    write(tmp_path / "again.csv", (OURS, 0, 12.0))
    loaded = study_repeats.load(tmp_path, tmp_path / "again.csv", "60 s")
    row = study_repeats.ratios(*loaded).splitlines()[2]
    assert row.startswith(f"| hopper_uni | {OURS} | {OTHER} | 1.00 (overlap)")
