"""What ``newton-qd envs NAME`` and ``newton-qd doctor`` say."""

from __future__ import annotations

import dataclasses
import errno
import functools
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

import newton_qd
from newton_qd import cli, tasks
from newton_qd.cli import health
from newton_qd.cli.arguments import require_writable
from newton_qd.envs.base import Env
from newton_qd.envs.pointmaze import PointMaze
from newton_qd.qd.config import ConfigError
from newton_qd.tasks import WrapperSpec
from newton_qd.wrappers import Wrapper


def test_an_environment_is_described(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["envs", "ant_uni"]) == cli.OK
    text = capsys.readouterr().out
    for part in (
        "observation: 87 numbers",
        "hip_1, gear ",
        "descriptor: feet_contact, limits 0 to 1, 0 to 1, 0 to 1, 0 to 1",
        "reward_forward: ",
        "FeetContactWrapper",
        "picture: ",
    ):
        assert part in text
    assert max(map(len, text.splitlines())) < 100
    assert cli.main(["envs", "pointmaze", "--json"]) == cli.OK
    found = json.loads(capsys.readouterr().out)
    assert found["descriptor"]["low"] == [-1, -1] and found["step_seconds"] == 1
    assert sum(block["size"] for block in found["observation"]) == 2
    assert cli.main(["envs", "antt"]) == cli.BAD_ARGUMENTS
    assert "does not exist" in capsys.readouterr().err


def test_a_description_says_what_wrappers_change(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["envs", "antmaze"]) == cli.OK
    text = " ".join(capsys.readouterr().out.split())
    assert text.startswith("antmaze: Ant, changed by XYPositionWrapper, MazeWrapper ")
    assert "Ant: A torso on four legs" in text
    assert "MazeWrapper: A maze with walls and a target." in text
    assert "The reward is minus the horizontal distance" in text
    assert cli.main(["envs", "ant"]) == cli.OK
    assert capsys.readouterr().out.startswith("ant: A torso on four legs")


class Same(Wrapper):
    """Changes nothing.

    And does so in each step.

    Attributes:
        price: What it costs.
    """

    def __init__(self, env: Env, env_name: str, price: float) -> None:
        super().__init__(env)
        self.price = price


def test_what_an_own_wrapper_says_is_told_without_its_arguments(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    wrapper = WrapperSpec(functools.partial(Same, price=1.0))
    task = dataclasses.replace(tasks.ENVIRONMENTS["pointmaze"], wrappers=(wrapper,))
    monkeypatch.setitem(tasks.ENVIRONMENTS, "pointmaze", task)
    assert cli.main(["envs", "pointmaze"]) == cli.OK
    text = capsys.readouterr().out
    assert "\nSame: Changes nothing. And does so in each step.\n\nstep: " in text


def test_a_class_without_a_text(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Plain(PointMaze):
        @property
        def action_size(self) -> int:
            return 1

    specs = {**tasks.ENVIRONMENTS, "plain": tasks.EnvironmentSpec(Plain, "plain")}
    monkeypatch.setattr(tasks, "ENVIRONMENTS", specs)
    assert cli.main(["envs", "plain"]) == cli.OK
    text = capsys.readouterr().out
    assert text.startswith("plain: its class has no description\n\nstep: 1 s\n")
    assert "action: 1 number\n" in text and "metrics" not in text


@pytest.mark.slow
def test_doctor_checks_the_installation(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert cli.main(["doctor", "--json"]) == cli.OK
    found = json.loads(capsys.readouterr().out)
    assert found["check"]["passed"] and found["kernel_cache"]["writable"]
    assert found["packages"]["jax"] and found["devices"]
    assert found["packages"]["newton_qd"] == newton_qd.__version__
    assert len(json.dumps(found)) > 200

    def broken(*arguments: object, **options: object) -> None:
        raise RuntimeError("no such thing")

    monkeypatch.setattr(newton_qd, "create", broken)
    assert cli.main(["doctor"]) == cli.FAILED
    assert "check failed: RuntimeError: no such thing" in capsys.readouterr().out


@pytest.mark.slow
def test_the_table_for_scripts(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["envs", "--json"]) == cli.OK
    rows = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in rows] == [*newton_qd.registered_envs()]


def test_an_environment_that_cannot_be_made_leaves_the_others(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Broken(PointMaze):
        @property
        def action_size(self) -> int:
            raise ZeroDivisionError("no actions")

    specs = {
        "broken": tasks.EnvironmentSpec(Broken, "broken"),
        "pointmaze": tasks.ENVIRONMENTS["pointmaze"],
    }
    monkeypatch.setattr(tasks, "ENVIRONMENTS", specs)
    why = "newton-qd envs: error: broken cannot be made: ZeroDivisionError: no actions"
    assert cli.main(["envs"]) == cli.FAILED
    seen = capsys.readouterr()
    names = [line.split()[0] for line in seen.out.splitlines()]
    assert (names, seen.err) == (["name", "pointmaze"], f"{why}\n")
    assert cli.main(["envs", "--json"]) == cli.FAILED
    seen = capsys.readouterr()
    assert [row["name"] for row in json.loads(seen.out)] == ["pointmaze"]
    assert seen.err == f"{why}\n"


@pytest.mark.parametrize("closed", ["stdout", "stderr"])
def test_a_closed_output_is_no_failure(
    closed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, closed, None)
    assert cli.main(["envs", "hopper"]) == cli.OK
    assert cli.main(["plot", "no such folder"]) == cli.BAD_ARGUMENTS


def test_a_character_that_a_terminal_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    written = io.BytesIO()
    stream = io.TextIOWrapper(written, encoding="ascii")
    monkeypatch.setattr(sys, "stderr", stream)
    assert cli.main(["plot", "pm\u00e9"]) == cli.BAD_ARGUMENTS
    assert b"pm\\xe9" in written.getvalue()


def test_the_doctor_prints_json_without_what(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["doctor", "--json", "gradients", "hopper"]) == cli.BAD_ARGUMENTS
    assert "--json: got it with gradients" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["--version"], ["-h"], ["envs", "pointmaze"]])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EPIPE])
def test_an_output_that_takes_nothing(
    arguments: list[str], number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk is a failure, and a reader who has left is none."""

    class Full(io.StringIO):
        def flush(self) -> None:
            raise OSError(number, "no")

        def fileno(self) -> int:
            return nowhere

    errors, nowhere = io.StringIO(), os.open(os.devnull, os.O_WRONLY)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", Full())
        patch.setattr(sys, "stderr", errors)
        code = cli.main(arguments)
    os.close(nowhere)
    full = number == errno.ENOSPC
    assert code == (cli.FAILED if full else cli.OK)
    assert ("output: [Errno 28] no" in errors.getvalue()) is full


def test_a_place_that_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before the slow part; a folder counts itself, and not what it lies in."""
    own, other = tmp_path / "own", tmp_path / "other"
    own.mkdir()
    other.mkdir()
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) == own)
    for good in (own, own / "new", own / "new" / "deep.gif"):
        require_writable("--out", good)
    for bad in (other, other / "new", tmp_path / "new", Path("/")):
        with pytest.raises(
            ConfigError, match=r"^--out: got .*, and .* cannot be writt"
        ):
            require_writable("--out", bad)
    (own / "file").touch()
    require_writable("--out", own / "file")
    with pytest.raises(ConfigError, match=r"file cannot be written"):
        require_writable("--out", own / "file" / "new")
    doctor = ["doctor", "gradients", "pointmaze", "--out", str(other / "new")]
    assert cli.main(doctor) == cli.BAD_ARGUMENTS
    assert "cannot be written; allowed: a place that can be" in capsys.readouterr().err


def test_the_doctor_reports_a_machine_without_devices(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def missing() -> None:
        raise RuntimeError("no device\nof that kind")

    def refused() -> str:
        raise OSError(errno.EROFS, "read-only", "/kernels")

    monkeypatch.setattr(jax, "devices", missing)
    monkeypatch.setattr("newton_qd.physics.cache.kernel_cache", refused)
    assert health._devices() == ["none (no device)"]
    assert health._kernel_cache() == {"folder": "/kernels", "writable": False}


def test_the_doctor_reports_a_cache_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    folder = str(tmp_path / "file" / "kernels")
    done = subprocess.run(
        [sys.executable, "-m", "newton_qd", "doctor", "--json"],
        env={**os.environ, "WARP_CACHE_PATH": folder},
        capture_output=True,
        text=True,
        check=False,
        timeout=100,
    )
    found = json.loads(done.stdout)
    assert found["kernel_cache"]["writable"] is False
    assert (
        done.returncode == cli.FAILED and "NotADirectory" in found["check"]["problem"]
    )
