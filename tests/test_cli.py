"""The command line: what it accepts, refuses, prints and writes."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from point_runs import SMALL, interrupt_after, point_task

import newton_qd
from newton_qd import cli
from newton_qd.qd.config import EvolveConfig, config_to_json
from newton_qd.qd.run.archive import load_archive
from newton_qd.qd.run.search import Search
from newton_qd.qd.scoring.task import Task

TESTS = Path(__file__).resolve().parent
POINT = ["evolve", "point", "--quiet", "--iterations", "3", "--batch-size", "16"]
POINT += ["--episode-length", "9", "--hidden", "4", "--grid", "4x4"]
POINT += ["--reevaluations", "2"]


def call(*arguments: object) -> int:
    return cli.main([str(a) for a in arguments], task_factory=point_task)


def test_evolve_reports_what_it_did(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert call(*POINT, "--out", out) == cli.OK
    captured = capsys.readouterr()
    assert captured.err == ""
    assert "point: 64 evaluations in 3 generations" in captured.out
    assert f"results in {out}" in captured.out
    settings = json.loads((out / "config.json").read_text())["settings"]
    assert settings["grid"] == [4, 4] and settings["hidden"] == [4]
    assert settings["iterations"] == 3 and settings["iso_sigma"] == SMALL.iso_sigma


def test_a_hint_names_a_folder_that_looks_like_an_option(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert call(*POINT, "--out=-x") == cli.OK
    hint = capsys.readouterr().out.rsplit("newton-qd ", 1)[1].split()
    assert hint == ["explore", "./-x"]
    assert call("eval", hint[1]) == cli.OK


@pytest.mark.slow
def test_a_config_file_reproduces_the_run(tmp_path: Path) -> None:
    first, again, other = (tmp_path / name for name in ("first", "again", "other"))
    assert call(*POINT, "--out", first) == cli.OK
    config = ["evolve", "--quiet", "--config", first / "config.json"]
    assert call(*config, "--out", again) == cli.OK
    for name in ("archive.npz", "archive.png", "metrics.csv", "config.json"):
        assert (again / name).read_bytes() == (first / name).read_bytes(), name
    assert call(*config, "--seed", 7, "--centroids", 9, "--out", other) == cli.OK
    assert len(load_archive(other).fitnesses) == 9
    settings = json.loads((other / "config.json").read_text())["settings"]
    assert settings["seed"] == 7 and settings["grid"] is None


def test_default_folder_and_resume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert call(*POINT, "--seed", 3) == cli.OK
    out = tmp_path / "results" / "point-seed3"
    before = {entry.name: entry.read_bytes() for entry in out.iterdir()}
    assert call(*POINT, "--seed", 3) == cli.BAD_ARGUMENTS
    assert "add --resume" in capsys.readouterr().err
    # The settings come from the folder, so none need be repeated.
    assert call("evolve", "--resume", "--quiet", "--out", out) == cli.OK
    resume = ["evolve", "point", "--resume", "--quiet", "--seed", 3]
    assert call(*resume) == cli.OK
    assert call(*resume, "--batch-size", 17) == cli.BAD_ARGUMENTS
    assert "batch_size: got 17; allowed: 16, as the run in" in capsys.readouterr().err
    assert call(*resume, "--centroids", 5) == cli.BAD_ARGUMENTS
    assert {entry.name: entry.read_bytes() for entry in out.iterdir()} == before


def test_files_of_others_are_never_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.png").touch()
    monkeypatch.chdir(tmp_path / "photos")
    for more in ([], ["--resume"]):
        assert call(*POINT, "--out", ".", *more) == cli.BAD_ARGUMENTS
        error = capsys.readouterr().err
        assert "which is not empty and has no config.json" in error
        assert "allowed: an empty or another folder" in error
        assert "add --resume" not in error
    path = tmp_path / "evil.toml"
    path.write_text('env_name = "../../evil"\n', encoding="utf-8")
    for given in (["--config", path], ["../../evil"]):
        assert call("evolve", *given, "--quiet") == cli.BAD_ARGUMENTS
        assert "env_name: got '../../evil'; allowed: letters" in capsys.readouterr().err
    found = sorted(path.name for path in tmp_path.rglob("*"))
    assert found == ["cat.png", "evil.toml", "photos"]


def test_other_arguments_come_before_a_used_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "cat.png").touch()
    for wrong, text in (
        (["--algorithm", "no"], "algorithm: got 'no', which does not exist"),
        (["--option", "courage=1"], "courage"),
        (["--device", "tpu"], "device: got 'tpu'; allowed"),
        (["--devices", "999"], "devices: got 999; allowed"),
        ([], "which is not empty"),
    ):
        assert call(*POINT, "--out", tmp_path, *wrong) == cli.BAD_ARGUMENTS
        assert text in capsys.readouterr().err
    (tmp_path / "cat.png").unlink()
    other = tmp_path / "other"
    other.mkdir()
    config = EvolveConfig(env_name="hopper_uni", grid=(64,))
    (other / "config.json").write_text(config_to_json(config, {}))
    resume = ["evolve", "point", "--resume", "--quiet", "--out", other]
    assert call(*resume) == cli.BAD_ARGUMENTS
    error = capsys.readouterr().err
    assert "env_name: got 'point'; allowed: 'hopper_uni', as the run in" in error
    assert call("evolve", "--resume", "--out", tmp_path / "no") == cli.BAD_ARGUMENTS
    error = capsys.readouterr().err
    assert f"out: got {tmp_path / 'no'}, which holds no run; allowed: the res" in error


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_gets_no_broken_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    plain, terminal = io.StringIO(), Terminal()
    for stream in (plain, terminal):
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stderr", stream)
            assert cli.main(["evolve", "ant_unicorn"]) == cli.BAD_ARGUMENTS
    assert plain.getvalue().count("\n") == 1
    lines = terminal.getvalue().splitlines()
    assert len(lines) > 3 and max(map(len, lines)) <= 40
    assert " ".join(lines) == plain.getvalue().rstrip("\n")


@pytest.mark.usefixtures("sigint")
def test_a_signal_during_the_reevaluation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    saved: list[str] = []
    reevaluate = Search.reevaluate

    def interrupted(self: Search, *arguments: Any, **options: Any) -> Any:
        saved.extend(entry.name for entry in out.iterdir())
        os.kill(os.getpid(), signal.SIGINT)
        return reevaluate(self, *arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Search, "reevaluate", interrupted)
        arguments = [*POINT, "--iterations", 1, "--out", out]
        assert call(*arguments) == cli.INTERRUPTED
    assert {"archive.npz", "archive.png"} <= set(saved)
    assert not (out / "corrected.json").exists()
    text = "interrupted during the re-evaluation, the archive is saved; continue with:"
    printed = capsys.readouterr().out
    assert text in printed and f"--resume --out {out}" in printed
    assert call("evolve", "--resume", "--quiet", "--out", out) == cli.OK
    assert (out / "corrected.json").exists()


@pytest.mark.usefixtures("sigint")
def test_a_reader_that_leaves_does_not_end_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    out = tmp_path / "run"
    arguments = [*POINT, "--out", out, "--resume"]
    arguments.remove("--quiet")
    with os.fdopen(writer, "w") as gone, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", gone)
        patch.setattr(sys, "stderr", gone)
        with monkeypatch.context() as once:
            interrupt_after(once, 1)
            codes = [call(*arguments)]
        codes.append(call(*arguments))
        codes.append(call(*arguments, "--seed", 3))
    assert codes == [cli.INTERRUPTED, cli.OK, cli.BAD_ARGUMENTS]
    assert len((out / "metrics.csv").read_text().splitlines()) == 5
    assert (out / "corrected.json").exists()


@pytest.mark.slow
def test_resume_starts_a_run_that_was_killed_too_early(tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert call(*POINT, "--resume", "--out", out) == cli.OK
    assert (out / "archive.npz").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("sigint")
def test_a_signal_before_the_first_generation(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted_task(config: EvolveConfig) -> Task:
        os.kill(os.getpid(), signal.SIGINT)
        return point_task(config)

    out = tmp_path / "run"
    arguments = [*POINT, "--out", str(out)]
    assert cli.main(arguments, task_factory=interrupted_task) == cli.INTERRUPTED
    assert "interrupted before the initial population" in capsys.readouterr().out
    assert [entry.name for entry in out.iterdir()] == ["config.json"]
    assert call("evolve", "--resume", "--quiet", "--out", out) == cli.OK


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evolve"], "ENV: got None; allowed: the name of an env"),
        (["evolve", "--resume"], "ENV: got None; allowed: the name of an env"),
        (
            ["evolve", "--resume", "--out", "nowhere"],
            "ENV: got None; allowed: the name of an env",
        ),
        (["evolve", "ant_unicorn"], "known names: ant, ant_uni"),
        (["evolve", "ant"], "'ant', which has no descriptor; allowed: ant_omni, "),
        (["evolve", "ant_uni", "--batch-size", "0"], "batch_size: got 0; allowed"),
        (["evolve", "ant_uni", "--seed", "-3"], "seed: got -3; allowed"),
        (["evolve", "ant_uni", "--grid", "5x5"], "5x5, which has 2 dimensions"),
        (["evolve", "ant_uni", "--iso-sigma", "nan"], "iso_sigma: got nan; allowed"),
        (["evolve", "ant_uni", "--checkpoint-seconds", "nan"], "checkpoint_seconds"),
        (["evolve", "--config", "none.json"], "cannot read none.json"),
        (["evolve", "ant_uni", "--grid", "5"], "5, which has 1 dimension;"),
        (["evolve", "--study"], "ENV: got None; allowed: the name of an environment"),
        (["evolve", "reacher", "--study"], "env_name: got 'reacher'; allowed: env"),
    ],
)
def test_bad_arguments_write_nothing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(arguments) == cli.BAD_ARGUMENTS
    captured = capsys.readouterr()
    assert message in captured.err and "results" not in captured.out
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "COMMAND"),
        (["fly"], "invalid choice: 'fly'"),
        (["evolve", "ant_uni", "--seed", "one"], "invalid int value: 'one'"),
        (
            ["evolve", "ant_uni", "--grid", "5,5"],
            "got '5,5'; allowed: integers like 8x8",
        ),
        (
            ["evolve", "ant_uni", "--hidden", "8x8"],
            "got '8x8'; allowed: integers like 8,8",
        ),
        (["evolve", "a", "--grid", "5x5", "--centroids", "9"], "not allowed with"),
        (["evolve", "a", "--study", "--config", "b.toml"], "not allowed with"),
        (["evolve", "ant_uni", "--bogus"], "--bogus"),
    ],
)
def test_arguments_that_cannot_be_parsed(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments)
    assert ended.value.code == cli.BAD_ARGUMENTS
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_a_damaged_checkpoint_is_a_failure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert call(*POINT, "--out", out) == cli.OK
    (out / "checkpoint.bin").write_bytes(b"newton_qd checkpoint 2 0\n")
    assert call("evolve", "--resume", "--quiet", "--out", out) == cli.FAILED
    assert "checkpoint.bin is damaged" in capsys.readouterr().err


def test_a_missing_extra_is_a_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "qdax", None)
    out = tmp_path / "run"
    assert call(*POINT, "--out", out) == cli.FAILED
    assert "pip install 'newton_qd[qd]'" in capsys.readouterr().err
    assert not out.exists()


def test_a_full_disk_is_a_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    assert call(*POINT, "--out", tmp_path / "run") == cli.FAILED
    assert "No space left on device" in capsys.readouterr().err


def test_help_is_quick_and_light() -> None:
    code = (
        "import sys\n"
        "from newton_qd import cli\n"
        "try:\n"
        "    cli.main(['evolve', '--help'])\n"
        "except SystemExit as ended:\n"
        "    assert ended.code == 0\n"
        "heavy = {'jax', 'warp', 'newton', 'qdax', 'matplotlib'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=TESTS,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    assert "--resume" in done.stdout


# --- the real thing --------------------------------------------------------


def test_envs_lists_every_environment(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["envs"]) == cli.OK
    table = [line.split() for line in capsys.readouterr().out.splitlines()]
    rows = {row[0]: row[1:] for row in table[1:]}
    assert set(rows) == set(newton_qd.registered_envs())
    assert rows["ant_uni"] == ["87", "8", "feet_contact", "(4)", "4.35"]
    assert rows["ant"] == ["87", "8", "-", "-"]


@pytest.mark.slow
def test_ant_uni_evolves_and_resumes(tmp_path: Path) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    small = ["evolve", "ant_uni", "--quiet", "--batch-size", "16"]
    small += ["--episode-length", "20", "--iterations", "6"]
    assert cli.main([*small, "--out", str(whole)]) == cli.OK
    code = (
        "import os, signal, sys\n"
        "from newton_qd import cli\n"
        "from newton_qd.qd.run.folder import RunFolder\n"
        "save = RunFolder.save\n"
        "def save_and_die(self, checkpoint):\n"
        "    save(self, checkpoint)\n"
        "    if checkpoint.iteration == 2:\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "RunFolder.save = save_and_die\n"
        "cli.main(sys.argv[1:])\n"
    )
    arguments = [*small, "--checkpoint-seconds", "0", "--out", str(parts)]
    killed = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=TESTS,
        capture_output=True,
        check=False,
        timeout=300,
    )
    assert killed.returncode == -9
    assert not (parts / "archive.npz").exists()
    assert cli.main(["evolve", "--quiet", "--resume", "--out", str(parts)]) == cli.OK
    for name in ("archive.npz", "archive.png", "metrics.csv", "config.json"):
        assert (parts / name).read_bytes() == (whole / name).read_bytes(), name
    archive = load_archive(parts)
    assert archive.centroids.shape == (625, 4)
    assert np.all(archive.descriptors >= 0) and np.all(archive.descriptors <= 1)
