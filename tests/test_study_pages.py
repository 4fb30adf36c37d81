"""The tables of the study's pages are those of its runs."""

from __future__ import annotations

import functools
import re
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path.insert(0, str(FOLDER))

import study_helpers  # noqa: E402
import study_pages  # noqa: E402
from study_runs import TUNING_SEED  # noqa: E402


@pytest.mark.slow
@pytest.mark.parametrize("page", study_pages.PAGES, ids=lambda page: page.stem)
def test_pages_have_the_tables_of_the_runs(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert study_pages.written(text) == text, "run: python benchmarks/study_pages.py"


def test_every_named_table_is_found() -> None:
    """A comment that is not quite right would leave its table as it is."""
    for page in study_pages.PAGES:
        text = page.read_text(encoding="utf-8")
        found = list(study_pages.TABLE.finditer(text))
        assert len(found) == text.count("study_pages.py -->") > 0
        assert all(one["rows"] for one in found)


def test_a_table_is_replaced_and_the_rest_is_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(study_pages.KINDS, "echo", lambda stop: f"| {stop} |")
    head = "<!-- table: echo, {}; benchmarks/study_pages.py -->\n\n"
    old = f"a\n\n{head}| b |\n|---|\n\nc\n{head}"
    new = f"a\n\n{head}| {{}} |\n\nc\n{head}| {{}} |\n"
    stops = "60 s", "20 s, 60 s"
    written = study_pages.written(old.format(*stops))
    assert written == new.format(stops[0], stops[0], stops[1], stops[1])


def test_a_kind_that_is_not_known() -> None:
    text = "<!-- table: none, 60 s; benchmarks/study_pages.py -->\n\n| a |\n"
    with pytest.raises(ValueError, match=re.escape("kind of a table: 'none'; there")):
        study_pages.written(text)


def test_long_runs_have_their_own_score_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The reported run after 250 s may be another one than that after 1,000 s."""

    def write(path: Path, *rows: tuple[str, int, str, float]) -> None:
        study_helpers.write(
            path,
            *(
                study_helpers.scored(
                    "me@7", seed, score, task="ant_uni", stop=stop, commit=commit
                )
                for commit, seed, stop, score in rows
            ),
        )

    write(
        tmp_path / "runs.csv",
        *(("first", 0, "250 s", 1000.0), ("later", 0, "1000 s", 3000.0)),
        ("continued", 1, "1000 s", 4000.0),
        *((name, TUNING_SEED, stop, 9.0) for name in "ab" for stop in ("1000 s",)),
    )
    repeats = tmp_path / "again.csv"
    write(repeats, ("later", 0, "250 s", 2000.0), ("later", 1, "250 s", 1.0))
    monkeypatch.setattr(study_pages, "FIELD", tmp_path)
    monkeypatch.setattr(study_pages, "REPEATS", repeats)
    head, _, *rows = study_pages.long_runs().splitlines()
    assert head == "| task | variant | seed | 250 s | 1,000 s |"
    assert rows == [
        "| ant_uni | me@7 | 0 | 2,000 | 3,000 |",
        "| ant_uni | me@7 | 1 | - | 4,000 |",
    ]


def test_the_fix_is_compared_with_the_mean_of_equal_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    new, old = (
        functools.partial(study_helpers.scored, variant, task="ant_uni")
        for variant in ("dcrl-me@7", "dcrl-me@7-median")
    )
    first = new(0, 6.0), old(0, 2.0), old(1, 4.0)
    study_helpers.write(tmp_path / "runs.csv", *first)
    repeats = tmp_path / "again.csv"
    study_helpers.write(repeats, new(0, 12.0), new(TUNING_SEED, 99.0))
    monkeypatch.setattr(study_pages, "FIELD", tmp_path)
    monkeypatch.setattr(study_pages, "REPEATS", repeats)
    monkeypatch.setattr(study_pages, "FIXED", {"ant_uni": 7, "antmaze": 7})
    head, _, *rows = study_pages.fixed("60 s").splitlines()
    assert head == "| task | variant | 60 s |"
    assert rows == ["| ant_uni | 7 | 3.00 (1, 2) |", "| antmaze | 7 | - |"]
