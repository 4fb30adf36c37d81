"""Tables and figures of the protocols ``field`` and ``small`` of ``study.py``.

    python benchmarks/study_scores.py field --out docs/field.md --figures docs/figures

``study_results.py`` says what the scores are. They are interquartile means over seeds
with bootstrap intervals of 95 %.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from study_figure import distribution, ratios
from study_protocols import PROTOCOLS
from study_report import interval
from study_results import (
    LEAST_SEEDS,
    Results,
    Scored,
    common,
    compared,
    enough,
    load,
    normalized,
    note_best,
    references,
    sides_of,
    to_best_other,
)

MILLION = "1000000 evaluations"
PUBLISHED = {
    "hopper_uni": {"me": 401, "pga-me": 474, "dcrl-me": 527, "ascii-me": 680},
    "walker2d_uni": {"me": 434, "pga-me": 542, "dcrl-me": 645, "ascii-me": 767},
}
"""Medians of QD scores [thousands] at a million evaluations (Mitsides et al. 2025)."""

OTHERS = {
    "me": "MAP-Elites",
    "dcrl-me": "DCRL-ME",
    "pga-me": "PGA-ME",
    "ascii-me": "ASCII-ME",
    "cma-me": "CMA-ME",
}
"""Names of the baselines."""

LONG = (
    *("corrected mean fitness over common cells", "QD score", "coverage [%]"),
    *("best", "time [s]"),
)
"""Columns that a short table leaves out."""


def text(values: list[float], spec: str) -> str:
    """Interquartile mean and its interval; one value has none."""
    if not values:
        return "-"
    if len(values) == 1:
        return f"{values[0]:{spec}}"
    middle, low, high = interval([np.asarray(values)])
    return f"{middle:{spec}} ({low:{spec}} to {high:{spec}})"


def corrected(runs: Sequence[Scored], limits: tuple[float, float]) -> list[str]:
    """Corrected QD score, the same without offset, and corrected coverage [%]."""
    scores = [float(run.line["corrected_qd_score"]) for run in runs]
    shares = [float(run.line["corrected_coverage"]) for run in runs]
    plain = [normalized(run, limits) for run in runs]
    return [text(scores, ",.0f"), text(plain, ".4f"), text(shares, ".1f")]


def table(results: Results, stop: str, *, short: bool = False) -> str:
    """Markdown table of all tasks and algorithms at a stop.

    Args:
        results: The runs.
        stop: The stop.
        short: Whether the columns of uncorrected scores, of common cells and of the
            time are left out.
    """
    limits = references(results)
    rows: list[dict[str, str]] = []
    keys = sorted(key for key in results if key[2] == stop)
    for task, group in itertools.groupby(keys, key=lambda key: key[0]):
        shared = {} if short else common(results, task, stop)
        for key in group:
            runs = results[key]

            def column(name: str, runs: list[Scored] = runs) -> list[float]:
                return [float(run.line[name]) for run in runs]

            score, plain, share = corrected(runs, limits[task])
            clock = "wall_s" if runs[0].line["device"] == "cuda" else "processor_s"
            row = {
                "task": task,
                "algorithm": key[1],
                "seeds": str(len(runs)),
                "**corrected QD score**": score,
                "**without offset**": plain,
                "corrected mean fitness over common cells": text(
                    shared.get(key[1], []), ".4g"
                ),
                "corrected coverage [%]": share,
                "corrected best": text(column("corrected_max_fitness"), ".4g"),
                "QD score": text(column("qd_score"), ",.0f"),
                "coverage [%]": text(column("coverage"), ".1f"),
                "best": text(column("max_fitness"), ".4g"),
                "evaluations [k]": f"{np.mean(column('evaluations')) / 1e3:.0f}",
                "time [s]": f"{np.mean(column(clock)):.0f}",
            }
            left_out = LONG if short else ()
            rows.append({n: cell for n, cell in row.items() if n not in left_out})
    return markdown(list(rows[0]), [list(row.values()) for row in rows])


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Returns a Markdown table."""
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def overview(results: Results, rival: str | None = None) -> str:
    """Markdown table: our ratio to the best baseline, by task and stop.

    Those with enough seeds count first. With ``rival``, only this other algorithm
    counts. Bold: the intervals do not overlap. Stops where nothing can be compared are
    left out.
    """
    stops = sorted({key[2] for key in results}, key=lambda stop: (len(stop), stop))
    tasks = sorted({key[0] for key in results})
    columns = {
        named(stop): [_ratio(results, task, stop, rival) for task in tasks]
        for stop in stops
    }
    columns = {name: c for name, c in columns.items() if set(c) != {"-"}}
    return markdown(["task", *columns], zip(tasks, *columns.values(), strict=True))


def _ratio(results: Results, task: str, stop: str, rival: str | None) -> str:
    """A cell of the overview."""
    found = to_best_other(results, task, stop, rival)
    if found is None:
        return "-"
    ratio, word, seeds = found
    mark = "**" if word == "apart" else ""
    few = f" ({seeds} seed{'s' * (seeds > 1)})" if seeds < LEAST_SEEDS else ""
    return f"{mark}{ratio:.2f}{mark}{few}"


def each(results: Results, stop: str) -> str:
    """Markdown table: our ratio to each other algorithm, with its best variant."""
    rows = [
        [task, *(_ratio(results, task, stop, rival) for rival in OTHERS)]
        for task in sorted({key[0] for key in results})
    ]
    return markdown(["task", *OTHERS.values()], rows)


def seeds(results: Results, stops: Sequence[str]) -> str:
    """Markdown table: seeds at each stop of the variants that are compared there."""

    def number(task: str, stop: str, rival: str | None) -> str:
        side = sides_of(results, task, stop, rival)[rival is not None]
        return str(max(enough(side))[4]) if side else "0"

    rows = [
        [
            task,
            *(
                ", ".join(number(task, s, name) for s in stops)
                for name in (None, *OTHERS)
            ),
        ]
        for task in sorted({key[0] for key in results})
    ]
    return markdown(["task", "ours", *OTHERS.values()], rows)


def named(stop: str) -> str:
    """Returns the name of a stop in the documentation."""
    amount, unit = stop.split()
    return "a million evaluations" if stop == MILLION else f"{int(amount):,} {unit}"


def against(results: Results, rival: str, stops: Sequence[str]) -> str:
    """Markdown table: the scores of ours and of the best variant of a rival."""
    head = ["task"]
    rows = {task: [task] for task in sorted({key[0] for key in results})}
    for stop in stops:
        head += [f"{named(stop)}: ours", rival, "ratio"]
        for task, cells in rows.items():
            sides = sides_of(results, task, stop, rival)
            ours, best = (max(enough(side)) for side in sides)
            ratio, word = compared(ours[:3], best[:3], min(ours[4], best[4]))
            mark = "" if word == "apart" else f" ({word})"
            cells += [f"{ours[0]:,.0f}", f"{best[0]:,.0f}", f"{ratio:.2f}{mark}"]
    return markdown(head, rows.values())


def verdict(results: Results, stop: str) -> str:
    """Markdown table: our best algorithm and the best baseline of each task.

    Ours has the chosen variant. Others have the one that is best here, of those with
    enough seeds, if there are any.
    """
    head = "task", "our best: corrected QD score", "best baseline", "ratio", "intervals"
    rows = []
    for task in sorted({key[0] for key in results}):
        sides = sides_of(results, task, stop)
        if not all(sides):
            continue
        ours, best = (max(enough(side)) for side in sides)
        seeds = min(ours[4], best[4])
        ratio, word = compared(ours[:3], best[:3], seeds)
        cells = [f"{x[3]} {x[0]:,.0f}" for x in (ours, best)]
        if seeds >= LEAST_SEEDS:
            pairs = zip(cells, (ours, best), strict=True)
            cells = [f"{cell} ({x[1]:,.0f} to {x[2]:,.0f})" for cell, x in pairs]
        rows.append([task, *cells, f"{ratio:.2f}", word])
    return markdown(head, rows)


def published(results: Results) -> str:
    """Markdown table: ratios to MAP-Elites with a million evaluations, and published.

    The published scores have no offset, and neither have these. They are of a single
    evaluation of each individual, as in the first variant of each algorithm.
    """
    rows = []
    for task, scores in PUBLISHED.items():
        sums: dict[str, list[float]] = {}
        for (own, _, stop), runs in results.items():
            name, number = runs[0].line["variant"].split("@")
            if (own, stop, number) == (task, MILLION, "1"):
                sums[name] = [run.raw[np.isfinite(run.raw)].sum() for run in runs]
        if "me" not in sums:
            continue
        base = np.median(sums["me"])
        for name in [name for name in scores if name in sums]:
            ratio, other = np.median(sums[name]) / base, scores[name] / scores["me"]
            rows.append([task, name, f"{ratio:.2f}", f"{other:.2f}"])
    head = "task", "algorithm", "ratio here", "published"
    return markdown(head, rows) if rows else ""


def report(results: Results) -> str:
    """Returns all tables."""
    parts = ["## Overview", overview(results)]
    parts += ["## Overview against MAP-Elites alone", overview(results, "me")]
    for stop in dict.fromkeys(key[2] for key in sorted(results, key=lambda k: k[2])):
        parts += [f"## At {stop}", verdict(results, stop), table(results, stop)]
    if found := published(results):
        parts += ["## Ratios to MAP-Elites", found]
    return "\n\n".join(parts) + "\n"


def main() -> None:
    """Prints the tables, and writes them and the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path)
    parser.add_argument("--out", type=Path, help="Markdown file of the tables")
    parser.add_argument("--figures", type=Path)
    parser.add_argument(
        "--note-best",
        action="store_true",
        help="add the best elites of these runs to study/best_known.csv",
    )
    args = parser.parse_args()
    results = load(args.runs)
    if not results:
        parser.error(f"runs: got {args.runs}; allowed: a folder with runs.csv")
    if args.note_best:
        note_best(results)
    known = {str(x) for protocol in PROTOCOLS.values() for x in protocol.stops}
    stops = sorted({key[2] for key in results} & known)
    if args.figures:
        for stop in stops:
            name = f"study_ccdf_{stop.replace(' ', '_')}.png"
            distribution(results, stop, args.figures / name)
        timed = sorted((s for s in stops if s.endswith(" s")), key=len)
        ratios(results, timed, args.figures / "study_ratios.png")
    content = report(results)
    if args.out:
        args.out.write_text(content, encoding="utf-8")
    print(content)


if __name__ == "__main__":
    main()
