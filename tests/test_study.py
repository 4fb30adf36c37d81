"""The protocols of the study: which runs are left."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import processes
import pytest

from newton_qd.qd.algorithms import ALGORITHMS, algorithm_named
from newton_qd.qd.config import EvolveConfig

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path.insert(0, str(FOLDER))

import study  # noqa: E402
import study_core  # noqa: E402
import study_pool  # noqa: E402
import study_results  # noqa: E402
import study_runs  # noqa: E402
from study_helpers import TASK, line  # noqa: E402
from study_protocols import BASELINES, FIELD, HUMANOIDS, OURS, PROTOCOLS, SMALL, Stop  # noqa: E402


@pytest.mark.parametrize("protocol", PROTOCOLS.values(), ids=lambda x: x.name)
def test_every_variant_is_a_setting(protocol: Any) -> None:
    known = {spec.name for spec in ALGORITHMS}
    assert set(protocol.algorithms) <= known
    variants = study_runs.variants()
    for algorithm in protocol.algorithms:
        own = [name for name in variants if name.split("@")[0] == algorithm]
        assert own and own[0] == f"{algorithm}@1"
        for name in own:
            given = {**protocol.settings_of(TASK), **variants[name]}
            config = EvolveConfig(env_name=TASK, algorithm=algorithm, **given)
            algorithm_named(algorithm).check_effect(config)
    assert protocol.settings_of(TASK)["hidden"] == [64, 64]


@pytest.mark.parametrize("task", study_core.TASKS)
def test_every_variant_of_one_core_is_a_setting(task: str) -> None:
    for variant in study_core.read("variants"):
        config = study_core.config_of(study_core.Run(task, variant, 0))
        algorithm_named(config.algorithm).check_effect(config)


@pytest.mark.parametrize("task", FIELD.tasks)
def test_baselines_get_as_many_variants(task: str) -> None:
    ours = [len(study_runs.numbered(name, task)) for name in OURS]
    others = [len(study_runs.numbered(name, task)) for name in BASELINES]
    assert 1 <= min(ours) and max(ours) <= min(others)


def test_variants_name_tasks_of_the_protocol() -> None:
    for name, given in study_runs._file().items():
        assert set(given.get("tasks", ())) <= set(FIELD.tasks), name
        assert "tasks" not in study_runs.variants()[name]


def test_ablations_are_run_by_name(tmp_path: Path) -> None:
    name = "me-conditioned@no-copies"
    assert name in study_runs.variants()
    assert name not in study_runs.numbered("me-conditioned", TASK)
    assert left(tmp_path, variants=[name], seeds=1) == [f"{TASK}.{name}.0"]


def test_humanoids_have_larger_policies() -> None:
    for name in HUMANOIDS:
        assert FIELD.settings_of(name)["hidden"] == [256, 256]
        assert FIELD.has(name, "me") and not FIELD.has(name, "cma-me")
    assert FIELD.has("ant_uni", "cma-me") and len(FIELD.tasks) == 10
    assert FIELD.seeds_of("me") == 20 and FIELD.seeds_of("pga-me") == 5


def test_stops_come_by_evaluations_and_time() -> None:
    assert Stop("evaluations", 10).reached(10, 0.0)
    assert not Stop("evaluations", 10).reached(9, 99.0)
    assert Stop("s", 60).reached(0, 60.0) and not Stop("s", 60).reached(99, 59.9)
    assert [str(x) for x in FIELD.stops_until(250)] == [
        "1000000 evaluations",
        "20 s",
        "60 s",
        "250 s",
    ]


def left(out: Path, until: float = 60, **given: Any) -> list[str]:
    options: dict[str, Any] = {"tasks": [TASK], "algorithms": ["me"], "seeds": 2}
    choice = study_runs.Choice(until=until, **{**options, **given})
    found = study_runs.missing(SMALL, out, choice)
    return [str(run) for run in found]


def test_without_tuning_chosen_variants_run_and_are_reported() -> None:
    reported = study_runs.lines(FOLDER / "results" / "field")
    for (task, algorithm, stop), variant in study_results.main_variants(
        reported
    ).items():
        if stop == "20 s":  # all runs came so far
            assert study_runs.chosen(algorithm, task) == variant
    choice = study_runs.Choice(
        tasks=[TASK], algorithms=["me", "me-actor-critic"], seeds=1, until=60
    )
    found = [run.variant for run in study_runs.planned(FIELD, choice)]
    assert found == ["me@5", "me-actor-critic@24"]
    found = [run.variant for run in study_runs.planned(SMALL, choice)]
    assert found == ["me@0", "me-actor-critic@0"]


def test_finished_runs_are_left_out(tmp_path: Path) -> None:
    assert left(tmp_path) == [f"{TASK}.me@0.0", f"{TASK}.me@0.1"]
    study_runs.add_line(tmp_path / "runs.csv", line("me", 0, "20 s"))
    assert left(tmp_path) == [f"{TASK}.me@0.0", f"{TASK}.me@0.1"]
    assert left(tmp_path, until=20) == [f"{TASK}.me@0.1"]
    study_runs.add_line(tmp_path / "runs.csv", line("me", 0, "60 s"))
    assert left(tmp_path) == [f"{TASK}.me@0.1"]
    assert len(left(tmp_path, reach=True)) == 2
    study_runs.add_line(tmp_path / "runs.csv", line("me", 0, "20000 evaluations"))
    assert left(tmp_path, reach=True) == [f"{TASK}.me@0.1"]
    assert len(study_runs.lines(tmp_path)) == 3


def test_a_list_can_change_while_it_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    listed = tmp_path / "list"
    listed.write_text("ant_uni me@1 0 60\n\nhopper_uni me@1 7 250\n")
    words = ["study.py", "--protocol", "field", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [*words, "--list", str(listed)])
    runs = study.coming(study.arguments())
    assert next(runs) == (60.0, ("ant_uni", "me@1", "0", str(tmp_path)))
    listed.write_text("ant_uni me@1 0 60\nant_uni me@1 0 250\nant_uni me@2 3 60\n")
    assert next(runs) == (250.0, ("ant_uni", "me@1", "0", str(tmp_path)))
    listed.write_text("ant_uni me@1 0 6\n")
    assert next(runs) == (60.0, ("ant_uni", "me@2", "3", str(tmp_path)))
    assert "got 'ant_uni me@1 0 6'; allowed: " in capsys.readouterr().err
    listed.write_text("ant_uni me@4 3 60\n")
    row = {**line("me", 3, "60 s"), "protocol": "field", "task": "ant_uni"}
    study_runs.add_line(tmp_path / "runs.csv", {**row, "variant": "me@4"})
    assert next(runs, None) is None


@pytest.mark.parametrize(
    "wrong",
    [
        *("ant me@1 0 60", "ant_uni me@x 0 60", "ant_uni me@1 -1 60"),
        *("ant_uni me@1 0 61", "ant_uni me@1 0", "ant_uni me@1 0 60 60"),
    ],
)
def test_a_wrong_line_of_a_list_is_told(tmp_path: Path, wrong: str) -> None:
    listed = tmp_path / "list"
    listed.write_text(f"ant_uni me@1 0 60\n{wrong}\n")
    with pytest.raises(ValueError, match=f"got '{wrong}'; allowed: TASK .* 60, 250"):
        study_runs.listed(listed, FIELD, tmp_path)


def test_tuning_chooses_the_corrected_score(tmp_path: Path) -> None:
    assert len(left(tmp_path, tune=True)) == 8
    for variant, gain in (("me@1", 3.0), ("me@2", 5.0), ("me@3", 4.0)):
        row = line("me", 1000, "20 s", corrected_qd_gain=gain) | {"variant": variant}
        study_runs.add_line(tmp_path / "runs.csv", row)
    assert study_runs.best_variant(tmp_path, TASK, "me") == "me@2"
    assert left(tmp_path / "other", tuned=tmp_path, seeds=1) == [f"{TASK}.me@2.0"]
    with pytest.raises(FileNotFoundError, match="no run of pga-me"):
        study_runs.best_variant(tmp_path, TASK, "pga-me")


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--seeds", "0"], "--seeds: got 0; allowed: an integer from 1"),
        (["--workers", "-1"], "--workers: got -1; allowed: an integer from 1"),
        (["--stop-after", "nan"], "--stop-after: got nan; allowed: a number above 0"),
        (["--protocol", "small", "--until", "6"], "--until: got 6; allowed: 20, 60"),
        (["--protocol", "small", "--seconds", "5"], "--seconds: got it without --pro"),
        (["--until", "60"], "--until: got it with --protocol core; use --seconds"),
        (["--tasks", "ant"], "--tasks: got ant; allowed: ant_uni, "),
        (["--algorithms", "ga"], "--algorithms: got ga; allowed: me, "),
        (["--protocol", "small", "--tasks", "ant"], "--tasks: got ant; allowed: "),
        (["--protocol", "small", "--run", "ant", "me@1", "0", "x"], "--run: got ant"),
        (["--protocol", "small", "--run", TASK, "ga@1", "0", "x"], "--run: got ga@1"),
        (["--protocol", "small", "--run", TASK, "me@1", "a", "x"], "--run: got a; "),
        (["--run", "ant", "me@1", "0", "x"], "--run: got ant; allowed: ant_uni, "),
        (["--run", TASK, "me", "0", "x"], "--run: got me; allowed: me@1, "),
        (["--variants", "me@1"], "--variants: got it without --protocol field or sm"),
        (["--tuned", "none"], "--tuned: none holds no run of me on ant_uni"),
        (["--protocol", "small", "--tuned", "none"], "--tuned: none holds no run of "),
    ],
)
def test_wrong_words_are_refused(
    words: list[str],
    text: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["study.py", *words])
    with pytest.raises(SystemExit):
        study.arguments()
    assert text in capsys.readouterr().err


def test_a_folder_has_runs_of_one_protocol(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Cells of the same stop would replace each other."""
    study_runs.add_line(tmp_path / "runs.csv", line("me", 0, "20 s"))
    words = ["--run", TASK, "me@0", "0", str(tmp_path)], ["--out", str(tmp_path)]
    for given in words:
        command = ["study.py", *given, "--protocol"]
        monkeypatch.setattr(sys, "argv", [*command, "small"])
        study.arguments()
        monkeypatch.setattr(sys, "argv", [*command, "field"])
        with pytest.raises(SystemExit):
            study.arguments()
        assert "allowed: a folder without runs of small" in capsys.readouterr().err


def test_a_row_does_not_name_a_gpu_that_is_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("jax.default_backend", lambda: "cpu")
    command = ["study.py", "--protocol", "small", "--device", "cuda", "--run", TASK]
    monkeypatch.setattr(sys, "argv", [*command, "me@0", "0", str(tmp_path)])
    with pytest.raises(SystemExit, match="--device: got cuda; allowed: cpu"):
        study.main()


def test_a_command_fails_if_a_run_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(study_pool, "STUDY", tmp_path / "missing.py")
    command = ["study.py", "--protocol", "small", "--out", str(tmp_path / "out")]
    choice = ["--tasks", TASK, "--algorithms", "me", "--seeds", "1"]
    monkeypatch.setattr(sys, "argv", [*command, *choice])
    with pytest.raises(SystemExit) as ended:
        study.main()
    assert ended.value.code == 1
    assert "failed: " in capsys.readouterr().err


def test_an_interrupt_ends_all_runs(tmp_path: Path, sigint: None) -> None:
    command = [sys.executable, "-u", FOLDER / "study.py", "--protocol", "small"]
    command += ["--tasks", TASK, "--algorithms", "me", "--out", str(tmp_path)]
    # signals of a terminal reach all processes of a group
    process = processes.start([*map(str, command)], start_new_session=True)
    assert process.stdout is not None
    assert TASK in process.stdout.readline()
    time.sleep(0.5)  # until the run has begun
    os.killpg(process.pid, signal.SIGINT)
    out, problems = process.communicate()
    assert process.returncode == study.INTERRUPTED
    assert "stopped: " in out and not problems
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)  # nobody is left


def test_a_command_without_a_run_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["study.py", "--protocol", "field", "--out", str(tmp_path)]
    choice = ["--tasks", "humanoid_uni", "--algorithms", "cma-me"]
    monkeypatch.setattr(sys, "argv", [*command, *choice])
    study.main()
    assert capsys.readouterr().out == "no run is left\n"
