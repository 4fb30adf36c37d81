"""Event files for TensorBoard: the metrics of metrics.csv, across a resumption."""

from __future__ import annotations

import importlib
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from point_runs import SMALL, compile_once, interrupt_after, run

from newton_qd.qd.config import ConfigError

__all__ = ["compile_once"]  # a fixture


def events(path: Path) -> Iterator[Any]:
    """Events of a file of records: length, its checksum, the event, its checksum."""
    messages: Any = importlib.import_module("tensorboardX.proto.event_pb2")
    content = path.read_bytes()
    while content:
        (length,) = struct.unpack("<Q", content[:8])
        yield messages.Event.FromString(content[12 : 12 + length])
        content = content[16 + length :]


def scalars(path: Path) -> dict[int, dict[str, float]]:
    """Values by generation and name."""
    found: dict[int, dict[str, float]] = {}
    for event in events(path):
        for value in event.summary.value:
            found.setdefault(event.step, {})[value.tag] = value.simple_value
    return found


@pytest.mark.usefixtures("sigint")
def test_event_files_hold_the_metrics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("tensorboardX")
    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        interrupt_after(patch, 7)
        assert run(out=out, tensorboard=True).interrupted
    metrics = run(out=out, tensorboard=True, resume=True).metrics
    first, second = sorted(
        (out / "tensorboard").iterdir(), key=lambda path: min(scalars(path))
    )
    assert list(scalars(first)) == list(range(8))
    assert list(scalars(second)) == list(range(8, 13))
    # TensorBoard forgets what comes after the beginning of the second part.
    begin = next(event for event in events(second) if event.HasField("session_log"))
    assert begin.step == 8 and begin.session_log.status == begin.session_log.START
    for generation, row in {**scalars(first), **scalars(second)}.items():
        assert set(row) == set(metrics) - {"iteration"}
        for name, value in row.items():
            assert value == pytest.approx(metrics[name][generation]), name


def test_event_files_need_a_folder() -> None:
    with pytest.raises(ConfigError, match=r"tensorboard: got True; .*a results folder"):
        run(SMALL, tensorboard=True)
