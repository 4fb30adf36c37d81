"""Runs of the study: one seed gives one result, also if a run stops on the way."""

from __future__ import annotations

import dataclasses
import json
import sys
import tempfile
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path.insert(0, str(FOLDER))

import study_clock  # noqa: E402
import study_execution  # noqa: E402
import study_runs  # noqa: E402
from study_protocols import Protocol, Stop  # noqa: E402
from study_runs import Run, lines  # noqa: E402

from newton_qd.qd.run.checkpoint import load_checkpoint, save_checkpoint  # noqa: E402

CLOCK = {"wall_s", "processor_s"}
PROTOCOL = Protocol(
    name="tiny",
    tasks=("hopper_uni",),
    algorithms=("me-actor-critic",),
    settings={
        "batch_size": 16,
        "episode_length": 10,
        "hidden": [8],
        "centroids": 16,
        "reevaluations": 2,
    },
    own={},
    stops=(Stop("evaluations", 40), Stop("evaluations", 90)),
    seeds=1,
    slow_seeds=1,
)
SETTINGS = {"me-actor-critic@1": {"options": {"copies": 2, "worlds": 4, "window": 4}}}
RUN = Run("hopper_uni", "me-actor-critic@1", 3)


@pytest.fixture(autouse=True)
def own_locks(tmp_path: Path, monkeypatch: Any) -> None:
    """No other test waits for the locks of this one."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def execute(out: Path, deadline: float = np.inf) -> bool:
    out.mkdir(exist_ok=True)
    limits = study_execution.Limits(60.0, deadline=deadline)
    return study_execution.execute(PROTOCOL, RUN, out, limits, "cpu")


def test_a_variant_changes_settings_of_its_parent(monkeypatch: Any) -> None:
    file = {
        "me@1": {"tasks": ["ant_uni"], "starts": 4, "options": {"a": 1, "b": 2}},
        "me@2": {"of": "me@1", "starts": 8, "options": {"b": 3}},
        "me@3": {"of": "me@2", "iso_sigma": 0.1},
    }
    monkeypatch.setattr(study_runs, "_file", lambda: file)
    found = study_runs.variants()
    assert found["me@1"] == {"starts": 4, "options": {"a": 1, "b": 2}}
    assert found["me@2"] == {"starts": 8, "options": {"a": 1, "b": 3}}
    assert found["me@3"] == {**found["me@2"], "iso_sigma": 0.1}


def test_a_clock_starts_when_no_other_run_uses_the_gpu() -> None:
    order = []

    def run() -> None:
        with study_clock.alone():
            order.append("clock")

    def later() -> None:
        with study_clock.shared():
            order.append("another")

    waiting = [threading.Thread(target=run), threading.Thread(target=later)]
    with study_clock.shared(), study_clock.shared():
        for thread in waiting:
            thread.start()
            thread.join(timeout=0.2)
        order.append("compiled")
    for thread in waiting:
        thread.join(timeout=10)
    # who asks later waits, or else the clock would never start
    assert order == ["compiled", "clock", "another"]


def test_a_pace_waits_for_runs_of_other_folders(
    tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setattr(study_clock, "LEAST_SECONDS", 0.0)
    ended = threading.Event()

    def measured() -> None:
        run = Run("hopper_uni", "me@1", 0)
        study_clock.pace(tmp_path, run, lambda: None, "H200", "abc")
        ended.set()

    other = threading.Thread(target=measured)
    with study_clock.shared():  # of a run whose folder is not known here
        other.start()
        assert not ended.wait(timeout=0.3)
    assert ended.wait(timeout=10)
    other.join()


def test_a_pace_is_measured_once(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(study_clock, "LEAST_SECONDS", 0.0)
    ran = []

    def pace(seed: int) -> float:
        run = Run("hopper_uni", "me@1", seed)
        return study_clock.pace(tmp_path, run, lambda: ran.append(1), "H200", "abc")

    first = pace(0)
    assert len(ran) == 1 + study_clock.LEAST_GENERATIONS
    assert pace(1) == pytest.approx(first, rel=1e-6)
    assert len(ran) == 1 + study_clock.LEAST_GENERATIONS
    assert study_clock.known_pace(tmp_path, Run("hopper_uni", "me@2", 0)) is None


def test_two_gpus_have_the_same_pace(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(study_clock, "LEAST_SECONDS", 0.0)
    path = tmp_path / study_clock.PACES
    found: list[float] = []

    def generation() -> None:
        if not path.is_file():  # the other GPU ends first
            monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1")
            other = study_clock.pace(
                tmp_path, RUN, lambda: time.sleep(0.002), "H200", "abc"
            )
            found.append(other)

    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    assert study_clock.pace(tmp_path, RUN, generation, "H200", "abc") == pytest.approx(
        found[0], rel=1e-6
    )
    assert len(path.read_text().splitlines()) == 2


def test_a_pace_is_that_of_the_slower_generations(
    tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setattr(study_clock, "LEAST_SECONDS", 0.0)
    paces = []
    for slow in (range(1, 11), range(11, 20), range(0)):
        ran = []

        def generation(slow: Any = slow, ran: list[int] = ran) -> None:
            ran.append(len(ran))
            if ran[-1] in slow:
                time.sleep(0.05)

        run = Run("hopper_uni", "me@1", 0)
        out = tmp_path / str(slow)
        out.mkdir()
        found = study_clock.pace(out, run, generation, "H200", "abc", later=12)
        paces.append(found)
        assert len(ran) == 12 + study_clock.LEAST_GENERATIONS
    assert min(paces[:2]) > 0.05 > 0.04 > paces[2]


class Clockwork:
    """A run whose generations take a second and have ten evaluations."""

    def __init__(self) -> None:
        self.stops = [Stop("evaluations", 50), Stop("s", 2)]
        self.state = SimpleNamespace(metrics=np.zeros((1, 2)))

    def advance(self) -> None:
        self.state = SimpleNamespace(metrics=np.add(self.state.metrics, (1, 10)))

    def seconds(self, wall: bool) -> float:
        return float(self.state.metrics[-1, 0])

    def save(self) -> None:
        pass

    forget = save


@pytest.mark.parametrize("reach", [False, True])
def test_a_run_can_go_on_to_its_evaluations(
    tmp_path: Path, monkeypatch: Any, reach: bool
) -> None:
    written = []
    monkeypatch.setattr(
        study_execution, "_write", lambda _, run, stop, *rest: written.append(str(stop))
    )
    run: Any = Clockwork()
    limits = study_execution.Limits(2.0, reach)
    study_execution._to_the_end(PROTOCOL, run, set(), tmp_path, limits, "processor")
    assert written == ["2 s", "50 evaluations"][: 1 + reach]
    assert run.seconds(False) == (5.0 if reach else 3.0)


def test_stops_before_a_saved_state_are_not_written(
    tmp_path: Path, monkeypatch: Any
) -> None:
    written = []
    monkeypatch.setattr(
        study_execution, "_write", lambda _, run, stop, *rest: written.append(str(stop))
    )
    run: Any = Clockwork()
    for _ in range(3):
        run.advance()  # the lines of this part are in another folder
    limits = study_execution.Limits(9.0)
    study_execution._to_the_end(PROTOCOL, run, set(), tmp_path, limits, "processor")
    assert written == ["50 evaluations"]


@pytest.mark.parametrize("states", [False, True])
def test_a_run_need_not_save_its_state(
    tmp_path: Path, monkeypatch: Any, states: bool
) -> None:
    saved = []
    monkeypatch.setattr(study_execution, "_write", lambda *_: None)
    monkeypatch.setattr(Clockwork, "save", lambda _: saved.append(1))
    run: Any = Clockwork()
    limits = study_execution.Limits(2.0, states=states)
    study_execution._to_the_end(PROTOCOL, run, set(), tmp_path, limits, "processor")
    assert bool(saved) == states


@pytest.mark.slow
def test_a_paced_run_counts_its_generations(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(study_execution, "variants", lambda: SETTINGS)
    monkeypatch.setattr(study_clock, "LEAST_SECONDS", 0.0)
    limits = study_execution.Limits(60.0, paced=True)
    assert study_execution.execute(PROTOCOL, RUN, tmp_path, limits, "cuda")
    pace = study_clock.known_pace(tmp_path, RUN)
    assert pace is not None
    for line in lines(tmp_path):
        assert line["clock"] == "paced"
        generations = int(line["iteration"]) + 1  # and the initial population
        assert float(line["wall_s"]) == pytest.approx(pace * generations, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("earlier", [False, True])
def test_a_row_repeats_bitwise(tmp_path: Path, monkeypatch: Any, earlier: bool) -> None:
    """Also if an earlier version has written the state, with its clock beside it."""
    monkeypatch.setattr(study_execution, "variants", lambda: SETTINGS)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert execute(whole)
    assert not execute(parts, deadline=0.0)  # stops after the first generation
    state = parts / "states" / f"{RUN}.state"
    assert state.is_file()
    if earlier:
        held = load_checkpoint(state)
        spent = dict(zip(("wall_s", "processor_s"), held.emitter[-1], strict=True))
        state.with_suffix(".json").write_text(json.dumps(spent))
        held = dataclasses.replace(held, emitter=held.emitter[:-1])
        save_checkpoint(state.with_suffix(".bin"), held)
        state.unlink()
    assert execute(parts)
    assert not list(state.parent.iterdir())
    begun, after = (float(row["processor_s"]) for row in lines(parts))
    assert 0 < begun < after
    assert [row["stop"] for row in lines(whole)] == [str(x) for x in PROTOCOL.stops]
    for one, other in zip(lines(whole), lines(parts), strict=True):
        assert {k: v for k, v in one.items() if k not in CLOCK} == {
            k: v for k, v in other.items() if k not in CLOCK
        }
    one, other = (np.load(out / "cells" / f"{RUN}.npz") for out in (whole, parts))
    for stop in PROTOCOL.stops:
        np.testing.assert_array_equal(one[str(stop)], other[str(stop)])
        assert np.isfinite(one[str(stop)][0]).any()
