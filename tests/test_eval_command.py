"""What ``newton-qd eval`` says of elites that are evaluated again."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from point_runs import SMALL, compile_once, point_task, reference

from newton_qd import cli
from newton_qd.qd.run.opened import Run
from newton_qd.qd.run.search import start_key

__all__ = ["compile_once", "reference"]  # fixtures


def evaluated(monkeypatch: pytest.MonkeyPatch, change: Any) -> None:
    """Changes the results of all evaluations of opened runs."""
    evaluate = Run.evaluate

    def changed(*arguments: Any, **options: Any) -> Any:
        return change(evaluate(*arguments, **options))

    monkeypatch.setattr(Run, "evaluate", changed)


def call(*arguments: object) -> int:
    return cli.main([str(a) for a in arguments], task_factory=point_task)


def test_another_descriptor_is_another_result(
    reference: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    evaluated(
        monkeypatch,
        lambda found: dataclasses.replace(found, descriptors=found.descriptors + 0.5),
    )
    assert call("eval", reference) == cli.FAILED
    assert "have other results" in capsys.readouterr().out


@pytest.mark.parametrize(("again", "share"), [(-10.5, "0%"), (-11.5, "100%")])
def test_a_tenth_of_a_negative_fitness_is_lost_below_it(
    again: float,
    share: str,
    reference: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    best = Run.best

    def of_ten(*arguments: Any) -> Any:
        return [dataclasses.replace(e, fitness=-10.0) for e in best(*arguments)]

    monkeypatch.setattr(Run, "best", of_ten)
    evaluated(
        monkeypatch,
        lambda found: dataclasses.replace(
            found, fitnesses=np.full_like(found.fitnesses, again)
        ),
    )
    assert call("eval", reference, "--best", 3, "--starts", 2) == cli.OK
    assert f", {share} lost more than a tenth" in capsys.readouterr().out


def test_other_starts_are_not_the_start_of_the_run(
    reference: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also with the seed of the run, which is the default of both."""
    start = start_key(SMALL.seed)
    evaluate, seen = Run.evaluate, []

    def watched(found: Run, cells: Any, keys: Any) -> Any:
        seen.append(keys)
        return evaluate(found, cells, keys)

    monkeypatch.setattr(Run, "evaluate", watched)
    assert call("eval", reference, "--starts", 3) == cli.OK
    assert [keys.shape for keys in seen] == [(3,)]
    assert not np.any(seen[0] == start)
