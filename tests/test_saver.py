"""When checkpoints are written."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from newton_qd.qd.run import loop


@pytest.mark.parametrize(("seconds", "saves"), [(5.0, 2), (0.0, 60), (100.0, 0)])
def test_checkpoints_that_take_long_come_seldom(
    monkeypatch: pytest.MonkeyPatch, seconds: float, saves: int
) -> None:
    """A checkpoint takes 2 s, and a generation 1 s."""
    now = 0.0
    written = []

    def write(state: Any) -> None:
        nonlocal now
        now += 2.0
        written.append(state)

    monkeypatch.setattr(loop, "time", SimpleNamespace(monotonic=lambda: now))
    search: Any = SimpleNamespace(checkpoint=lambda state: state)
    folder: Any = SimpleNamespace(save=write)
    saver = loop.Saver(search, folder, seconds)
    state: Any = SimpleNamespace(iteration=0)
    for _ in range(60):
        now += 1.0
        saver.sometimes(state)
    assert len(written) == saves
