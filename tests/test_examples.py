"""The examples run, with arguments that make them short."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def test_gradient_of_return(capsys: pytest.CaptureFixture[str]) -> None:
    path = EXAMPLES / "gradient_of_return.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    example.main(["--worlds", "2", "--steps", "4", "--iterations", "2"])
    printed = capsys.readouterr().out
    assert "iteration   2: mean return" in printed and "faulty 0" in printed
    returns = [
        float(line.partition("mean return")[2].partition(",")[0])
        for line in printed.splitlines()
        if "mean return" in line
    ]
    assert len(returns) == 3 and returns[-1] > returns[0]
