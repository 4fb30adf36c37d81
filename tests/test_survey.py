"""The table of reward offsets is the one that the survey has measured."""

from __future__ import annotations

from pathlib import Path

import newton_qd

PAGE = Path(__file__).parents[1] / "docs" / "survey.md"


def rows() -> dict[str, list[str]]:
    """Cells of the page by task, without its name."""
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
    return {row[0].strip("`"): row[1:] for row in cells if row and row[0][:1] == "`"}


def test_offsets_are_measured() -> None:
    found = rows()
    assert list(found) == list(newton_qd.tables.reward_offset)
    for name, (_, _, lowest, original, offset) in found.items():
        assert float(offset) == newton_qd.tables.reward_offset[name]
        there = newton_qd.tables.original_reward_offset.get(name)
        assert original == "-" if there is None else float(original) == there
        # rounded up to hundredths; a task that is never punished needs none
        assert 0 <= float(offset) + min(0.0, float(lowest)) < 0.011


def test_no_task_is_degenerate() -> None:
    for name, (coverage, *_) in rows().items():
        # more than one of 1,024 cells
        assert float(coverage) > 0.15, name
