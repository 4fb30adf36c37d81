"""The examples run, with tiny arguments."""

from __future__ import annotations

import re
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import newton_qd.compat

# QDax and what it imports warn about their own use of other packages.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
TINY = ["--env", "pointmaze", "--batch-size", "8", "--episode-length", "5"]
FEW = ["--iterations", "2"]


@pytest.fixture(autouse=True)
def no_trace() -> Iterator[None]:
    yield
    newton_qd.compat.uninstall()


@pytest.mark.parametrize(
    ("name", "arguments", "printed"),
    [
        (
            "gradient_of_return",
            ["--worlds", "2", "--steps", "4", *FEW],
            r"iteration   2: mean return .*faulty 0",
        ),
        (
            "gait_repertoire",
            ["--steps", "5", "--batch-size", "8", *FEW],
            r"feet on the ground 0\.\d+: ",
        ),
        ("gradient_qd", [*TINY, *FEW], r"iteration 2: QD score .* rejected 0"),
        ("ribs_cma_maega", [*TINY, *FEW], r"iteration 1: QD score [\d,]+, coverage"),
        (
            "plan_hopper",
            ["--plans", "2", "--steps", "4", *FEW],
            r"iteration   2: mean return .*best",
        ),
        ("lift_object", ["--steps", "4"], r"the object is 0\.9\d m high"),
        (
            "train_ant",
            ["--worlds", "2", "--steps", "4", *FEW],
            r"iteration   2: mean return .*faulty 0",
        ),
        ("qdax_map_elites", [*TINY, *FEW], r"iteration 2: QD score [\d,]+, coverage"),
        ("qdax_pga_me", [*TINY, *FEW, "--training-steps", "2"], r"QD score [\d,]+"),
        ("ribs_cma_me", [*TINY, *FEW], r"as a repertoire of QDax: \d+ elites"),
        ("sharded_evaluation", TINY, "the same results: True"),
    ],
)
def test_example_runs(
    name: str,
    arguments: list[str],
    printed: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = EXAMPLES / f"{name}.py"
    assert len(path.read_text(encoding="utf-8").splitlines()) < 80
    monkeypatch.setattr(sys, "argv", [str(path), *arguments])
    runpy.run_path(str(path), run_name="__main__")
    assert re.search(printed, capsys.readouterr().out)
