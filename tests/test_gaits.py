"""The comparison of gaits, with simulations that are formulas."""

from __future__ import annotations

import csv
import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "gaits.py"


@pytest.fixture(scope="module")
def gaits() -> ModuleType:
    spec = importlib.util.spec_from_file_location("benchmark_gaits", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def fake(scale: float) -> Any:
    """A worker: the return is ``scale`` times 10 minus the summed squared error."""

    def ask(command: str, **arguments: Any) -> dict[str, Any]:
        assert command == "gaits"
        table = np.asarray(arguments["gaits"])
        score = 10 - np.square(table[..., 0] - 0.7).sum(axis=-1)
        score = scale * (score - np.square(table[:, 0, 1] - 4.0))
        values = [score.tolist() for _ in arguments["seeds"]]
        names = ("returns", "endless", "forward", "steps")
        return {**dict.fromkeys(names, values), "faults": 0}

    return ask


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ([1, 2, 3, 4], [10, 20, 30, 50], 1.0),
        ([1, 2, 3, 4], [4, 3, 2, 1], -1.0),
        # ranks 1, 2.5, 2.5, 4 and 3, 1.5, 1.5, 4; covariance 1.5, variances 4.5
        ([1, 2, 2, 3], [4, 1, 1, 9], 1 / 3),
    ],
)
def test_rank_correlation(
    gaits: ModuleType, a: list[float], b: list[float], expected: float
) -> None:
    found = gaits.rank_correlation(np.array(a), np.array(b))
    assert found == pytest.approx(expected)


def test_gaits_are_in_their_ranges(gaits: ModuleType) -> None:
    for kind in gaits.KINDS:
        drawn = gaits.draw(500, 6, kind, (0.5, 3.0))
        np.testing.assert_array_equal(drawn, gaits.draw(500, 6, kind, (0.5, 3.0)))
        for column, high in enumerate((1.0, 3.0, 2 * np.pi)):
            low = 0.5 if column == 1 else 0.0
            values = drawn[..., column]
            assert values.min() == pytest.approx(low, abs=0.02)
            assert values.max() == pytest.approx(high, abs=0.02)
        same = bool((drawn[:, :, 1] == drawn[:, :1, 1]).all())
        assert same == (kind == "shared")


def test_comparison(gaits: ModuleType, tmp_path: Path) -> None:
    asks = {"newton_qd": fake(0.5), "brax_v1": fake(1.0)}
    text = gaits.compare(asks, ["halfcheetah"], {}, tmp_path)
    ours = [line for line in text.splitlines() if "| newton_qd |" in line]
    # two kinds of gaits, two kinds of searches; the search finds the top of the formula
    assert len(ours) == 4
    assert all("| 0.50 |" in line for line in ours)
    assert all("| 1.00 | 1.00 |" in line for line in ours[:2])
    assert (tmp_path / "gaits.md").read_text(encoding="utf-8").endswith(f"{text}\n")
    with (tmp_path / "gaits_search.csv").open(encoding="utf-8") as file:
        best = [
            float(row["best_return"])
            for row in csv.DictReader(file)
            if row["simulation"] == "brax v1" and row["search"] != "random"
        ]
    assert len(best) == gaits.SEARCHES
    assert min(best) > 9.5
    with (tmp_path / "gaits.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == gaits.GAITS * len(gaits.KINDS) * 5


def test_only_ours(gaits: ModuleType) -> None:
    text = gaits.compare({"newton_qd": fake(1.0)}, ["hopper"], {"substeps": 9}, None)
    assert text.count('newton_qd {"substeps": 9}') == len(gaits.KINDS)
    assert "brax v1 |" not in text.replace("ratio to brax v1 |", "")
