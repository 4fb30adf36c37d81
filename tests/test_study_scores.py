"""What the report of the study says of its runs."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path.insert(0, str(FOLDER))

import study_figure  # noqa: E402
import study_maze  # noqa: E402
import study_regions  # noqa: E402
import study_results  # noqa: E402
import study_runs  # noqa: E402
import study_scores  # noqa: E402
from study_helpers import CELLS, TASK, add, line  # noqa: E402
from study_report import interval  # noqa: E402


def names(folder: Path, runs: tuple[tuple[str, int], ...]) -> dict[str, list[int]]:
    """Seeds of each algorithm of the report, if these variants ran with these seeds."""
    (folder / "cells").mkdir(parents=True)
    for variant, seed in runs:
        cells: dict[str, Any] = {"20 s": np.ones((2, CELLS))}
        np.savez(folder / "cells" / f"{TASK}.{variant}.{seed}.npz", **cells)
        row = line("me", seed, "20 s") | {"variant": variant}
        study_runs.add_line(folder / "runs.csv", row)
    found = study_results.load(folder)
    return {key[1]: [run.seed for run in runs] for key, runs in found.items()}


def test_a_folder_without_runs_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["study_scores.py", str(tmp_path / "none")])
    with pytest.raises(SystemExit):
        study_scores.main()
    assert "none; allowed: a folder with runs.csv" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("script", "given", "text"),
    [
        pytest.param(
            "shares",
            "ant_uni me@1",
            "variant: got me@1; allowed: .* of two kinds",
            marks=pytest.mark.slow,
        ),
        ("shares", "ant_uni me@x", "variant: got me@x; allowed: a key of"),
        ("shares", "hopper me-actor-critic@1", "env_name: got 'hopper', .* descriptor"),
        ("study_report", "none", "runs: got none; allowed: a folder with files TASK"),
        (
            "by_generation",
            "hopper_uni me@1 --every 10 --generations 5",
            "--every: got 10; allowed: at most --generations = 5",
        ),
        ("actor_alone", "nope", "env_name is 'nope'; known names: ant, "),
        ("actor_alone", "ant_uni --every 0", "--every: got 0; allowed: an integer"),
        ("climbing", "walker2d_uni me@1 --climbers 0", "options: climbers: got 0"),
        ("climbing", "walker2d_uni me@x", "variant: got me@x; allowed: a key of"),
    ],
)
def test_a_script_says_what_is_wrong(
    script: str,
    given: str,
    text: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", [f"{script}.py", *given.split()])
    with pytest.raises(SystemExit):
        importlib.import_module(script).main()
    assert re.search(text, capsys.readouterr().err)


def test_the_chosen_variant_has_the_name(tmp_path: Path) -> None:
    runs = (("me@1", 0), ("me@3", 0), ("me@3", 1), ("me@3", 1000), ("me@cut", 0))
    expected = {"me": [0, 1], "me@1": [0], "me@cut": [0]}
    assert names(tmp_path / "most", runs) == expected  # the chosen one did not run
    chosen = study_runs.chosen("me", TASK)
    expected = {"me": [0], "me@1": [0], "me@3": [0, 1], "me@cut": [0]}
    assert names(tmp_path / "chosen", ((chosen, 0), *runs)) == expected


def test_a_chosen_variant_has_the_name_where_it_came_so_far() -> None:
    main = study_runs.chosen("me", TASK)
    rows = [line("me", 0, stop) | {"variant": main} for stop in ("20 s", "60 s")]
    more = [line("me", 0, stop) | {"variant": "me@1"} for stop in ("60 s", "250 s")]
    assert study_results.main_variants(rows + more) == {
        (TASK, "me", "20 s"): main,
        (TASK, "me", "60 s"): main,
        (TASK, "me", "250 s"): "me@1",
    }


def test_runs_before_a_fix_have_the_name_only_if_there_are_more() -> None:
    def name(*variants: str) -> str:
        rows = [line("dcrl-me", 0, "20 s") | {"variant": name} for name in variants]
        (found,) = study_results.main_variants(rows).values()
        return found

    before, after = "dcrl-me@5-median", "dcrl-me@5"
    assert name(before, after) == name(after, before) == after
    assert name(before, after, before) == before
    assert study_results.is_variant(before)


def test_a_number_of_evaluations_can_have_another_variant() -> None:
    main = study_runs.chosen("me-actor-critic", TASK)
    other = study_runs.chosen("me-actor-critic", TASK, at_evaluations=True)
    assert main != other
    rows = [
        line("me-actor-critic", 0, stop) | {"variant": variant}
        for stop in ("1000000 evaluations", "60 s")
        for variant in (main, other)
    ]
    assert study_results.main_variants(rows) == {
        (TASK, "me-actor-critic", "1000000 evaluations"): other,
        (TASK, "me-actor-critic", "60 s"): main,
    }
    assert study_runs.chosen("me", TASK, at_evaluations=True) == study_runs.chosen(
        "me", TASK
    )


def test_the_best_variant_of_others_is_compared() -> None:
    results = {}
    scores = {"me": 2.0, "me@1": 3.0, "me@cut": 9.0, "me-actor-critic": 4.0}
    for name, score in {**scores, "me-actor-critic@4": 9.0}.items():
        row = line(name.split("@")[0], 0, "20 s", corrected_qd_score=score)
        archive = np.full(CELLS, score)
        results[TASK, name, "20 s"] = [study_results.Scored(0, row, archive, archive)]
    rows = study_scores.verdict(results, "20 s").splitlines()[2:]
    assert rows == [f"| {TASK} | me-actor-critic 4 | me@1 3 | 1.33 | too few seeds |"]


def test_enough_seeds_count_first() -> None:
    def runs(algorithm: str, score: float, seeds: int) -> list[study_results.Scored]:
        row = line(algorithm, 0, "20 s", corrected_qd_score=score)
        return [study_results.Scored(0, row, np.empty(0), np.empty(0))] * seeds

    ours = runs("me-actor-critic", 4.0, 3)
    results = {
        (TASK, "me-actor-critic", "20 s"): ours,
        (TASK, "me", "20 s"): runs("me", 2.0, 3),
        (TASK, "me@1", "20 s"): runs("me", 3.0, 1),
        (TASK, "me-actor-critic", "60 s"): ours,
        (TASK, "me@1", "60 s"): runs("me", 3.0, 1),
        (TASK, "me", "250 s"): runs("me", 2.0, 3),
    }
    assert study_scores.overview(results).splitlines()[::2] == [
        "| task | 20 s | 60 s |",
        f"| {TASK} | **2.00** | 1.33 (1 seed) |",
    ]
    row = study_scores.verdict(results, "20 s").splitlines()[2]
    assert row.endswith("| me 2 (2 to 2) | 2.00 | apart |")
    results[TASK, "dcrl-me", "20 s"] = runs("dcrl-me", 8.0, 3)
    first = f"| {TASK} | **0.50** |", f"| {TASK} | **2.00** |"
    for rival, start in zip((None, "me"), first, strict=True):
        assert study_scores.overview(results, rival).splitlines()[2].startswith(start)


def scored(stop: str, scores: dict[str, float], seeds: int) -> study_results.Results:
    """Runs of variants, each with so many seeds."""
    found = {}
    for name, score in scores.items():
        row = line(name.split("@")[0], 0, stop, corrected_qd_score=score)
        run = study_results.Scored(0, row, np.empty(0), np.empty(0))
        found[TASK, name, stop] = [run] * seeds
    return found


def test_ours_are_compared_with_each_baseline() -> None:
    results = scored("60 s", {"me": 4.0}, seeds=1)
    others = {"dcrl-me": 1.0, "dcrl-me@1": 2.0, "me-actor-critic": 8.0}
    results |= scored("60 s", others, seeds=3)
    assert study_scores.each(results, "60 s").splitlines()[::2] == [
        "| task | MAP-Elites | DCRL-ME | PGA-ME | ASCII-ME | CMA-ME |",
        f"| {TASK} | 2.00 (1 seed) | **4.00** | - | - | - |",
    ]


def test_seeds_are_those_of_the_compared_variants() -> None:
    results = scored("60 s", {"me-actor-critic": 8.0, "me": 4.0}, seeds=5)
    results |= scored("60 s", {"dcrl-me": 1.0, "me-actor-critic@2": 9.0}, seeds=7)
    results |= scored("250 s", {"me-actor-critic": 8.0, "me@1": 5.0}, seeds=2)
    results |= scored("60 s", {"dcrl-me@1": 2.0}, seeds=3)
    assert study_scores.seeds(results, ["60 s", "250 s"]).splitlines()[::2] == [
        "| task | ours | MAP-Elites | DCRL-ME | PGA-ME | ASCII-ME | CMA-ME |",
        f"| {TASK} | 5, 2 | 5, 2 | 3, 0 | 0, 0 | 0, 0 | 0, 0 |",
    ]


def test_published_ratios_are_of_single_evaluations() -> None:
    stop = "1000000 evaluations"
    results = {}
    for name, variant, value in (
        ("me", "me@5", 9.0),
        ("me@1", "me@1", 1.0),
        ("dcrl-me", "dcrl-me@1", 1.5),
    ):
        row = line(variant.split("@")[0], 0, stop) | {"variant": variant}
        raw = np.array([value, value, -np.inf])
        results[TASK, name, stop] = [study_results.Scored(0, row, raw, raw)]
    rows = study_scores.published(results).splitlines()[2:]
    assert rows == [
        f"| {TASK} | me | 1.00 | 1.00 |",
        f"| {TASK} | dcrl-me | 1.50 | 1.31 |",
    ]


def test_ours_are_compared_with_the_best_variant_of_a_rival() -> None:
    scores = {"dcrl-me": 2.0, "dcrl-me@1": 3.0, "me": 9.0, "me-actor-critic": 1500.0}
    results = scored("20 s", scores, seeds=1)
    assert study_scores.against(results, "dcrl-me", ["20 s"]).splitlines()[::2] == [
        "| task | 20 s: ours | dcrl-me | ratio |",
        f"| {TASK} | 1,500 | 3 | 500.00 (too few seeds) |",
    ]


def test_stops_have_the_names_of_the_documentation() -> None:
    stops = "20 s", "1000 s", "20000 evaluations", "1000000 evaluations"
    assert [study_scores.named(stop) for stop in stops] == [
        *("20 s", "1,000 s", "20,000 evaluations", "a million evaluations"),
    ]


def test_the_best_known_fitness_only_rises(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(study_results, "BEST_KNOWN", tmp_path / "best_known.csv")
    for best in (4.0, 2.0):
        add(tmp_path, "me", 0, "20 s", [best] * CELLS)
        study_results.note_best(study_results.load(tmp_path))
        # the elites lose 1 when they are evaluated again
        assert study_results.best_known() == {TASK: 3.0}
        (tmp_path / "runs.csv").unlink()


def test_the_report_compares_corrected_archives(
    tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setattr(study_results, "BEST_KNOWN", tmp_path / "best_known.csv")
    empty, stop = -np.inf, "20 s"
    me = [4.0, empty, 6.0, empty, 3.0, 2.0, empty, empty]
    ours = [9.0, 5.0, 11.0, empty, empty, empty, empty, empty]
    for seed in (0, 1, 2):
        add(tmp_path, "me", seed, stop, me)
        add(tmp_path, "me-conditioned", seed, stop, ours)
    add(tmp_path, "me", study_runs.TUNING_SEED, stop, ours)
    results = study_results.load(tmp_path)
    # untrained: 2; best known: 11 - 1 after another evaluation
    assert study_results.references(results) == {TASK: (2.0, 10.0)}
    shared = study_results.common(results, TASK, stop)
    assert shared == {"me": [4.0] * 3, "me-conditioned": [9.0] * 3}
    scores = {
        key[1]: study_results.normalized(runs[0], (2.0, 10.0))
        for key, runs in results.items()
    }
    assert scores["me"] == pytest.approx((1 + 3) / 8 / CELLS)
    assert scores["me-conditioned"] == pytest.approx((6 + 2 + 8) / 8 / CELLS)
    content = study_scores.report(results)
    assert "| hopper_uni | me-conditioned 52 (52 to 52) | me 51 (51 to 51)" in content
    assert "| 1.02 | apart |" in content
    assert "| hopper_uni | me | 3 | 51 (51 to 51) | 0.0625 (0.0625 to" in content
    assert interval([np.array([1.0, 1.0])]) == (1.0, 1.0, 1.0)
    figures = tmp_path / "figures"
    study_figure.ratios(results, [stop], figures / "ratios.png")
    # a stop that nothing reached has no place in the legend
    study_figure.ratios(results, [stop, "1000 s"], figures / "again.png")
    assert (figures / "again.png").read_bytes() == (figures / "ratios.png").read_bytes()
    study_figure.distribution(results, stop, figures / "ccdf.png")
    assert (figures / "ccdf.png").exists()


def test_regions_have_the_mean_of_their_filled_cells() -> None:
    places = np.array([0.0, 0.2, 0.3, 0.5, 1.0])
    fitnesses = np.array([1.0, 3.0, 7.0, -np.inf, 9.0])
    low, middle, high = study_regions.regions(places, fitnesses, [0.0, 0.3, 0.6, 1.0])
    assert low == (2.0, 100.0)
    assert middle == (7.0, 50.0)
    assert high == (9.0, 100.0)  # the last region includes its end
    for empty in ([0.4, 0.6], [2.0, 3.0]):  # no elite; no cell
        (alone,) = study_regions.regions(places, fitnesses, empty)
        assert np.isnan(alone[0]) and alone[1] == 0.0
    assert study_regions.cell([(4.0, 50.0), (np.nan, 0.0)]) == "4 (25 %)"
    assert study_regions.cell([(np.nan, 0.0)]) == "-"


def test_the_table_of_regions_names_what_has_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    add(tmp_path, "me", 0, "60 s", 2 * np.arange(CELLS))
    monkeypatch.setattr(study_regions, "places", lambda *_: np.linspace(0, 1, CELLS))
    command = ["study_regions.py", str(tmp_path), TASK]
    monkeypatch.setattr(sys, "argv", [*command, "me@0", "--ranges", "0", "0.5", "1"])
    study_regions.main()
    # elites lose 1 when they are evaluated again
    assert "| 0 to 0.5 | 2 (100 %) |" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", [*command, "me@9"])
    with pytest.raises(SystemExit):
        study_regions.main()
    assert "variants: got me@9" in capsys.readouterr().err


def test_the_maze_has_the_runs_that_came_to_the_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(study_maze, "TASK", TASK)
    monkeypatch.setattr(study_maze, "draw", lambda *_: None)
    places = np.stack([np.linspace(0, 30, CELLS)] * 2, axis=1)
    monkeypatch.setattr(study_maze, "cells_of", lambda *_: (places, ()))
    for seed, stop in ((0, "60 s"), (3, "60 s"), (0, "1000 s")):
        add(tmp_path, "me", seed, stop, np.arange(CELLS))
    command = ["study_maze.py", str(tmp_path), "me@0"]
    monkeypatch.setattr(sys, "argv", [*command, "--stop", "1000 s"])
    study_maze.main()
    _, _, *rows = capsys.readouterr().out.splitlines()
    assert rows == ["| 0 | 3 of 3 | 3 | 42 |"]  # 21, 26 and 30 m are beyond 20 m
    for wrong, text in (
        ([*command, "--seeds", "1"], "--seeds: got [1]; allowed: [0, 3]"),
        (["study_maze.py", str(tmp_path), "me@9"], "variant: got me@9; allowed: one "),
    ):
        monkeypatch.setattr(sys, "argv", wrong)
        with pytest.raises(SystemExit):
            study_maze.main()
        assert text in capsys.readouterr().err
