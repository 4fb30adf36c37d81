"""Runs that stop and go on: signals, kills, damaged and foreign folders."""

from __future__ import annotations

import dataclasses
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import processes
import pytest
from point_runs import (
    SMALL,
    TESTS,
    assert_same_results,
    compile_once,
    copy,
    damage,
    evolve_module,
    interrupt_after,
    point_task,
    reference,
    run,
    snapshot,
    writes_of,
)

from newton_qd import cli, files
from newton_qd.qd.config import ConfigError, EvolveConfig, read_config
from newton_qd.qd.run.archive import load_archive
from newton_qd.qd.run.checkpoint import CheckpointError, load_checkpoint
from newton_qd.qd.run.folder import RunFolder
from newton_qd.qd.run.interrupt import INTERRUPTED, graceful_stop
from newton_qd.qd.run.leaves import leaf_to_device, leaf_to_host
from newton_qd.qd.run.progress import Progress
from newton_qd.qd.run.search import Search, SearchError

__all__ = ["compile_once", "reference"]  # fixtures

# QDax and what it imports warn about their own use of other packages.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.mark.parametrize("generator", ["threefry2x32", "rbg"])
def test_a_key_of_an_emitter_keeps_its_generator(generator: str) -> None:
    key = jax.random.key(3, impl=generator)
    like = jax.eval_shape(lambda: key)
    assert leaf_to_device(leaf_to_host(key), like) == key


@pytest.mark.optimized
@pytest.mark.parametrize("generation", [0, 1, 7, 12])
@pytest.mark.usefixtures("sigint")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_saves_and_resumes_bit_by_bit(
    reference: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    generation: int,
    number: int,
) -> None:
    out = tmp_path / "run"
    handler = signal.getsignal(number)
    with monkeypatch.context() as patch:
        interrupt_after(patch, generation, number)
        # No checkpoint in between: the state is saved because of the signal.
        result = run(out=out, checkpoint_seconds=1e9)
    assert signal.getsignal(number) is handler
    assert result.iteration == generation
    assert result.interrupted == (generation < SMALL.iterations)
    assert len((out / "metrics.csv").read_text().splitlines()) == generation + 2
    assert np.array_equal(load_archive(out).fitnesses, result.archive.fitnesses)
    assert not run(out=out, resume=True).interrupted
    assert_same_results(out, reference)


def test_an_error_after_a_generation_loses_nothing(
    reference: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    advance = Search.advance

    def advance_or_fail(self: Search, state: Any) -> Any:
        if state.iteration == 3:
            raise SearchError("no memory")
        return advance(self, state)

    with monkeypatch.context() as patch:
        patch.setattr(Search, "advance", advance_or_fail)
        with pytest.raises(SearchError, match="no memory"):
            run(out=out, checkpoint_seconds=1e9)
    assert len((out / "metrics.csv").read_text().splitlines()) == 5
    assert load_checkpoint(out / "checkpoint.bin").iteration == 3

    def watch_and_fail(*_: Any) -> None:
        raise OSError("no display")

    with monkeypatch.context() as patch:
        patch.setattr(Progress, "update", watch_and_fail)
        with pytest.raises(OSError, match="no display"):
            run(out=out, resume=True, checkpoint_seconds=1e9)
    assert load_checkpoint(out / "checkpoint.bin").iteration == 4
    run(out=out, resume=True)
    assert_same_results(out, reference)


class Killed(BaseException):
    """Stands for SIGKILL at one moment."""


def test_a_kill_at_any_file_operation_can_be_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Before, in the middle of and after the writing of each file.
    monkeypatch.setattr(evolve_module, "archive_png", lambda *arguments: b"picture")
    config = SMALL.replace(iterations=2)
    expected = tmp_path / "expected"
    run(config, out=expected)
    moments = 3 * len(writes_of(config, tmp_path / "count", monkeypatch))
    assert moments > 20
    for moment in range(moments):
        out = tmp_path / f"run{moment}"
        with monkeypatch.context() as patch, pytest.raises(Killed):
            kill_at(patch, moment)
            run(config, out=out)
        # The command is the same whether or not the run had begun.
        run(config, out=out, resume=True)
        assert_same_results(out, expected)


def kill_at(patch: pytest.MonkeyPatch, moment: int) -> None:
    """Ends the run in the write number ``moment // 3``."""
    replace, calls = os.replace, iter(range(10**6))

    def replace_or_die(source: Path, target: Path) -> None:
        call = next(calls)
        if call == moment // 3 and moment % 3 == 0:  # half written
            content = Path(source).read_bytes()
            Path(source).write_bytes(content[: len(content) // 2])
            raise Killed
        if call == moment // 3 and moment % 3 == 1:  # whole, not yet in place
            raise Killed
        replace(source, target)
        if call == moment // 3:
            raise Killed

    patch.setattr(files.os, "replace", replace_or_die)


PROGRAM = (
    f"import sys; sys.path[:0] = [{str(TESTS)!r}]\n"
    "from point_runs import point_task\n"
    "from newton_qd.cli import main\n"
    "sys.exit(main(sys.argv[1:], task_factory=point_task))"
)

LONG = ["point", "--iterations", "150", "--batch-size", "16", "--episode-length"]

LONG += ["9", "--hidden", "4", "--grid", "4x4", "--checkpoint-seconds", "0"]


def start(*arguments: str) -> subprocess.Popen[str]:
    return processes.start([sys.executable, "-c", PROGRAM, "evolve", *arguments])


def wait_for_generation(out: Path, generation: int, process: Any) -> None:
    deadline = time.monotonic() + 120
    path = out / "metrics.csv"
    while not path.exists() or len(path.read_text().splitlines()) < generation + 2:
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < deadline
        time.sleep(0.005)


@pytest.mark.slow
def test_sigkill_at_random_moments(tmp_path: Path) -> None:
    expected, out = tmp_path / "expected", tmp_path / "run"
    process = start(*LONG, "--out", str(expected))
    begin = time.monotonic()
    wait_for_generation(expected, 0, process)
    compiled = time.monotonic() - begin
    _, errors = process.communicate(timeout=240)
    assert process.returncode == 0, errors
    whole = time.monotonic() - begin
    moments = random.Random(0)
    for attempt in range(6):
        process = start(*LONG, "--out", str(out), "--resume")
        # The first kills fall into start and compilation, the others into the loop.
        low = 0.0 if attempt < 2 else 0.9 * compiled
        high = compiled if attempt < 2 else 0.8 * compiled + 0.4 * whole
        time.sleep(moments.uniform(low, max(low, high)))
        process.kill()
        process.communicate()
    process = start(*LONG, "--out", str(out), "--resume")
    output, errors = process.communicate(timeout=240)
    assert process.returncode == 0, errors
    assert "150 generations" in output
    assert_same_results(out, expected)


@pytest.mark.slow
@pytest.mark.usefixtures("sigint")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_of_a_process(tmp_path: Path, number: int) -> None:
    out = tmp_path / "with space"
    process = start(*LONG, "--out", str(out))
    wait_for_generation(out, 3, process)
    process.send_signal(number)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == INTERRUPTED
    assert "Traceback" not in errors and "stopping" in errors
    assert f"newton-qd evolve --resume --out '{out}'" in output
    # here: what a process resumes is the test above, and its start takes seconds
    arguments = ["evolve", "--resume", "--out", str(out), "--checkpoint-seconds", "0"]
    assert cli.main(arguments, task_factory=point_task) == cli.OK
    rows = (out / "metrics.csv").read_text().splitlines()[1:]
    assert [int(row.split(",")[0]) for row in rows] == list(range(151))


@pytest.mark.usefixtures("sigint")
def test_a_second_signal_quits_at_once_even_from_compiled_code() -> None:
    code = (
        "import hashlib\n"
        "from newton_qd.qd.run.interrupt import graceful_stop\n"
        "with graceful_stop() as stop:\n"
        "    print('ready', flush=True)\n"
        "    hashlib.pbkdf2_hmac('sha256', b'', b'', 2**31 - 1)\n"
    )
    process = processes.start([sys.executable, "-c", code], cwd=TESTS)
    assert process.stdout is not None and process.stderr is not None
    assert process.stdout.readline() == "ready\n"
    process.send_signal(signal.SIGINT)
    assert process.stderr.readline() == "\n"
    assert "stopping" in process.stderr.readline()
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=30)
    assert process.returncode == INTERRUPTED


def test_other_threads_and_ignored_signals() -> None:
    seen: list[Any] = []

    def use() -> None:
        with graceful_stop() as stop:
            seen.append(stop.requested)

    thread = threading.Thread(target=use)
    thread.start()
    thread.join()
    assert seen == [False]
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        with graceful_stop():
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, before)


def test_resuming_a_finished_run_changes_nothing(
    reference: Path, tmp_path: Path
) -> None:
    out = copy(reference, tmp_path)
    (out / "archive.png").unlink()
    result = run(out=out, resume=True)
    assert result.iteration == SMALL.iterations and not result.interrupted
    assert_same_results(out, reference)


def test_a_used_folder_is_refused(reference: Path, tmp_path: Path) -> None:
    before = snapshot(reference)
    with pytest.raises(ConfigError, match=r"not empty.*--resume"):
        run(out=reference)
    assert snapshot(reference) == before
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.tex").write_text("text")
    for resume in (False, True):
        with pytest.raises(ConfigError, match="foreign"):
            run(out=foreign, resume=resume)
    assert snapshot(foreign) == {"thesis.tex": b"text"}
    with pytest.raises(ConfigError, match="is a file"):
        run(out=foreign / "thesis.tex")
    with pytest.raises(ConfigError, match="cannot create"):
        run(out=foreign / "thesis.tex" / "run")


CHANGES = {
    "seed": 1,
    "iterations": 11,  # more of them continue the run: tests/test_go_on.py
    "batch_size": 17,
    "episode_length": 10,
    "hidden": (5,),
    "grid": (4, 5),
    "iso_sigma": 0.1,
    "line_sigma": 0.1,
    "tournament": 2,
    "algorithm": "cma-me",
    "reevaluations": 2,
    "env_options": {"healthy_reward": 2.0},
    "starts": 2,
    "statistic": "median",
    "scatter": 1.0,
    "new_starts": True,
    "randomize": {"friction": (0.5, 1.5)},
    "warm_start": "0" * 64,
}


@pytest.mark.parametrize("name", CHANGES)
def test_resuming_with_a_changed_setting_names_it(reference: Path, name: str) -> None:
    before = snapshot(reference)
    shown = "start_from" if name == "warm_start" else name  # what a user gives
    with pytest.raises(ConfigError, match=f"^{shown}: got .* as the run in"):
        run(SMALL.replace(**{name: CHANGES[name]}), out=reference, resume=True)
    assert snapshot(reference) == before


def test_a_run_to_resume_is_in_a_folder() -> None:
    """Before, a run without one began anew, and saved nothing."""
    with pytest.raises(ConfigError, match=r"^resume: got True; .*results folder"):
        run(SMALL, resume=True)


def test_every_setting_has_a_changed_value() -> None:
    names = {field.name for field in dataclasses.fields(EvolveConfig)}
    assert names - set(CHANGES) == {"env_name", "centroids", "options"}


def test_every_damage_of_a_checkpoint_is_found(reference: Path, tmp_path: Path) -> None:
    out = copy(reference, tmp_path)
    path = out / "checkpoint.bin"
    for name, content in damage(path.read_bytes()).items():
        path.write_bytes(content)
        before = snapshot(out)
        with pytest.raises(CheckpointError, match=r"checkpoint\.bin.*damaged"):
            run(out=out, resume=True)
        assert snapshot(out) == before, name
    path.unlink()  # as the message says
    (out / "archive.npz").unlink()
    run(out=out, resume=True)
    assert_same_results(out, reference)


def test_a_checkpoint_of_another_run_is_refused(
    reference: Path, tmp_path: Path
) -> None:
    out = tmp_path / "other"
    run(SMALL.replace(seed=1), out=out)
    (out / "checkpoint.bin").write_bytes((reference / "checkpoint.bin").read_bytes())
    with pytest.raises(CheckpointError, match="other settings"):
        run(SMALL.replace(seed=1), out=out, resume=True)


def test_another_writer_is_refused(reference: Path, tmp_path: Path) -> None:
    out = copy(reference, tmp_path)
    with (
        RunFolder(out).lock(),
        pytest.raises(ConfigError, match="another process is writing"),
    ):
        run(out=out, resume=True)


def test_another_machine_is_noticed(
    reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = copy(reference, tmp_path)
    document = json.loads((out / "config.json").read_text())
    document["environment"]["packages"]["jax"] = "0.1"
    (out / "config.json").write_text(json.dumps(document))
    run(out=out, resume=True, progress=True)
    assert "warning: jax was 0.1" in capsys.readouterr().err
    document["environment"]["x64"] = True
    (out / "config.json").write_text(json.dumps(document))
    with pytest.raises(ConfigError, match="jax_enable_x64"):
        run(out=out, resume=True)


def test_a_config_file_returns_the_settings(reference: Path) -> None:
    facts: Any
    config, facts = read_config(reference / "config.json")
    assert config == SMALL
    assert facts["packages"]["jax"] == jax.__version__
    assert facts["x64"] is False
