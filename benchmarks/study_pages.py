"""Write the tables of the study's pages from its runs.

python benchmarks/study_pages.py            writes them into the pages
python benchmarks/study_pages.py --check    fails if one is out of date

A table of a page stands below a comment that names it: its kind, and a stop where the
kind wants one.
"""

from __future__ import annotations

import argparse
import csv
import functools
import re
import sys
from collections.abc import Callable
from pathlib import Path
from statistics import fmean

import study_repeats
import study_scores
from study_results import MEDIAN, Results, load, references
from study_runs import TUNING_SEED, lines

BENCHMARKS = Path(__file__).resolve().parent
DOCS = BENCHMARKS.parent / "docs"
FIELD = BENCHMARKS / "results" / "field"
REPEATS = BENCHMARKS / "results" / "field_repeats.csv"
SMALL = BENCHMARKS / "results" / "small"
NAMES = ("", "_details", "_reasons", "_scores", "_runs")
PAGES = tuple(DOCS / f"study{name}.md" for name in NAMES)
TABLE = re.compile(
    r"(?P<head><!-- table: (?P<kind>[^,\n]+)(?:, (?P<stop>[^\n]+))?; "
    r"benchmarks/study_pages\.py -->\n\n)(?P<rows>(?:\|.*\n)*)"
)
LONG, BEFORE = "1000 s", "250 s"
SCATTER = {
    "ant_omni": {"none": 12, "1": 17, "1, sixteen starts": 20},
    "ant_uni": {"none": 12, "1, sixteen starts": 20},
    "anttrap": {"none": 12, "1": 17, "1, sixteen starts": 20},
    "hopper_uni": {
        "none": 13,
        "1": "me-actor-critic@13-scatter-1",
        "3, sixteen starts": 21,
        "none, DCRL-ME": "dcrl-me@6-median",
        "10, sixteen starts, DCRL-ME": "dcrl-me@12-median",
    },
    "walker2d_uni": {
        "none": 14,
        "3": 19,
        "1, sixteen starts, noise on weights": 22,
        "none, DCRL-ME": "dcrl-me@6-median",
        "1, sixteen starts, DCRL-ME": "dcrl-me@11-median",
    },
}
"""Variants with and without scatter, of each task; a number is a variant of ours."""
FIXED = {
    **dict.fromkeys(("ant_omni", "ant_uni", "antmaze", "anttrap"), 7),
    **{"halfcheetah_uni": 6, "hopper_uni": 12, "walker2d_uni": 11},
}
"""Variants of DCRL-ME that ran with several seeds before and after its fix."""


@functools.cache
def _field() -> Results:
    return load(FIELD)


def _equal_runs(stop: str) -> str:
    return study_repeats.again(study_repeats.load(FIELD, REPEATS, stop)[0])[1]


def _repeats(stop: str) -> str:
    return study_repeats.ratios(*study_repeats.load(FIELD, REPEATS, stop))


def scatter(stop: str) -> str:
    """Markdown table: scores with and without scatter."""
    results = _field()
    limits = references(results)
    found = {
        (task, runs[0].line["variant"]): runs
        for (task, _, at), runs in results.items()
        if at == stop
    }
    rows = []
    for task, variants in SCATTER.items():
        for label, variant in variants.items():
            own = isinstance(variant, int)
            runs = found[task, f"me-actor-critic@{variant}" if own else variant]
            rows.append(
                [
                    task,
                    f"{label} ({variant})" if own else f"{label} (`{variant}`)",
                    str(len(runs)),
                    *study_scores.corrected(runs, limits[task]),
                ]
            )
    head = ("task", "scatter", "seeds", "corrected QD score", "without offset")
    return study_scores.markdown([*head, "corrected coverage [%]"], rows)


def long_runs() -> str:
    """Markdown table: the runs that came to the longest time, there and before."""
    with REPEATS.open(newline="", encoding="utf-8") as file:
        every = [*lines(FIELD), *csv.DictReader(file)]
    scores = {
        tuple(line[name] for name in ("task", "variant", "seed", "commit", "stop")): (
            f"{float(line['corrected_qd_score']):,.0f}"
        )
        for line in reversed(every)  # the first one counts
        if int(line["seed"]) != TUNING_SEED
    }
    rows = []
    for (*run, stop), score in sorted(scores.items()):
        task, variant, seed, _ = run
        if stop == LONG:
            # a run that another commit has continued has its earlier score there
            before = scores.get((*run, BEFORE), "-")
            rows.append([task, variant, seed, before, score])
    head = "task", "variant", "seed", study_scores.named(BEFORE)
    return study_scores.markdown([*head, study_scores.named(LONG)], rows)


def fixed(stops: str) -> str:
    """Markdown table: DCRL-ME after its fix, as a ratio to before, with all equal runs.

    In brackets are the numbers of seeds after and before it.
    """
    every = {
        stop: study_repeats.load(FIELD, REPEATS, stop)[0] for stop in stops.split(", ")
    }
    rows = []
    for task, number in FIXED.items():
        row = [task, str(number)]
        for runs in every.values():
            after, before = (
                [fmean(equal) for equal in runs.get((task, variant), {}).values()]
                for variant in (f"dcrl-me@{number}", f"dcrl-me@{number}{MEDIAN}")
            )
            if after and before:
                ratio = fmean(after) / fmean(before)
                row.append(f"{ratio:.2f} ({len(after)}, {len(before)})")
            else:
                row.append("-")
        rows.append(row)
    return study_scores.markdown(
        ["task", "variant", *map(study_scores.named, every)], rows
    )


KINDS: dict[str, Callable[[str], str]] = {
    "ratios": lambda _: study_scores.overview(_field()),
    "ratios to MAP-Elites": lambda _: study_scores.overview(_field(), "me"),
    "each": lambda stop: study_scores.each(_field(), stop),
    "seeds": lambda stops: study_scores.seeds(_field(), stops.split(", ")),
    "ours and DCRL-ME": lambda stops: study_scores.against(
        _field(), "dcrl-me", stops.split(", ")
    ),
    "best": lambda stop: study_scores.verdict(_field(), stop),
    "best on a CPU": lambda stop: study_scores.verdict(load(SMALL), stop),
    "scores": lambda stop: study_scores.table(_field(), stop, short=True),
    "scores on a CPU": lambda stop: study_scores.table(load(SMALL), stop, short=True),
    "published": lambda _: study_scores.published(_field()),
    "scatter": scatter,
    "long runs": lambda _: long_runs(),
    "after a fix": fixed,
    "equal runs": _equal_runs,
    "other runs": _repeats,
}
"""What writes the tables of a kind, given the stop."""


def written(text: str) -> str:
    """Returns the text of a page, with its tables anew.

    Raises:
        ValueError: A table is of an unknown kind.
    """

    def anew(found: re.Match[str]) -> str:
        kind = found["kind"]
        if kind not in KINDS:
            raise ValueError(f"kind of a table: {kind!r}; there are {sorted(KINDS)}")
        return f"{found['head']}{KINDS[kind](found['stop'] or '')}\n"

    return TABLE.sub(anew, text)


def main() -> int:
    """Writes the pages, or compares them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="write nothing")
    check = parser.parse_args().check
    old = 0
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        new = written(text)
        if new != text:
            old += 1
            print(f"{page.name}: {'out of date' if check else 'written'}")
            if not check:
                page.write_text(new, encoding="utf-8")
    return int(check and old > 0)


if __name__ == "__main__":
    sys.exit(main())
