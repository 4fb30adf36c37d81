"""``newton-qd eval`` and ``newton-qd plot``: open the results folder of a run."""

from __future__ import annotations

import argparse
import io
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.cli import modules
from newton_qd.cli.arguments import (
    BAD_ARGUMENTS,
    FAILED,
    OK,
    Commands,
    add_elite_choice,
    complain,
    holds_run,
    load_physics,
    print_table,
    say,
    warn_of_changes,
)
from newton_qd.files import write_atomically
from newton_qd.qd.config import ConfigError, EvolveConfig

if TYPE_CHECKING:
    from newton_qd.qd.run.evaluation import Evaluation
    from newton_qd.qd.run.opened import Elite, Run
    from newton_qd.qd.scoring.task import Task

    TaskFactory = Callable[[EvolveConfig], Task] | None

_MOST_SHOWN = 20


def add_parsers(commands: Commands) -> None:
    """Adds both commands to the subparsers of ``newton-qd``."""
    parser = commands.add_parser(
        "eval",
        help="evaluate the elites of a run again",
        description="Evaluates elites of a results folder from the start state of the "
        "run, and checks that fitness and descriptor are bitwise those of the archive. "
        "With --starts, evaluates them from other start states.",
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="results folder")
    add_elite_choice(parser, "the N fittest elites")
    parser.add_argument(
        "--starts",
        type=int,
        default=0,
        metavar="N",
        help="evaluate from N other start states (default: only from that of the run)",
    )
    parser.add_argument(
        "--seed", type=int, metavar="N", help="seed of --starts (default: 0)"
    )
    modules.add_argument(parser)
    parser.set_defaults(run=evaluate)

    parser = commands.add_parser(
        "plot",
        help="draw the archive and the learning curves of a run",
        description="Writes archive.png and curves.png of a results folder.",
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="results folder")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder for the pictures (default: the results folder)",
    )
    modules.add_argument(parser)
    parser.set_defaults(run=plot)


def opened(folder: Path, task_factory: TaskFactory) -> Run:
    """Opens a run; says what differs from the machine that made it.

    Raises:
        ConfigError: The folder does not exist, or holds no run.
    """
    if not folder.is_dir():
        why = "which is a file" if folder.exists() else "which does not exist"
        allowed = "a results folder, as newton-qd evolve writes it"
        raise ConfigError(message("DIR", str(folder), allowed, why=why))
    load_physics()
    from newton_qd.qd.run.opened import load_run
    from newton_qd.qd.scoring.task import make_task

    with warnings.catch_warnings(record=True) as caught:
        try:
            run = load_run(
                folder, task_factory=make_task if task_factory is None else task_factory
            )
        finally:
            for warning in caught:
                say(f"warning: {warning.message}", sys.stderr)
    warn_of_changes(run.facts, "when the run began")
    return run


def evaluate(arguments: argparse.Namespace, task_factory: TaskFactory = None) -> int:
    """Evaluates elites and prints a table. Returns the exit code.

    Raises:
        ConfigError: An argument is not allowed.
    """
    seed = checked_starts(arguments)
    if arguments.best is not None:
        checks.integer("--best", arguments.best, error=ConfigError)
    run = opened(arguments.folder, task_factory)
    try:
        elites = _chosen(run, arguments)
    except (LookupError, ValueError) as error:
        return complain(arguments, error, BAD_ARGUMENTS)
    if not elites:
        return complain(arguments, f"the archive in {run.path} is empty", FAILED)
    cells = [elite.cell for elite in elites]
    whole = arguments.cell is arguments.best is arguments.near is None
    if arguments.starts:
        from newton_qd.qd.run.search import other_start_keys

        keys = other_start_keys(seed, arguments.starts)
        _print_starts(run, elites, run.evaluate(cells, keys), whole)
        return OK
    return _print_repeated(run, elites, run.evaluate(cells), whole)


def checked_starts(arguments: argparse.Namespace) -> int:
    """Returns the seed of ``--starts``.

    Raises:
        ConfigError: An argument is not allowed, or has no effect.
    """
    most = 100_000  # all are evaluated at once
    checks.integer("--starts", arguments.starts, least=0, most=most, error=ConfigError)
    if arguments.seed is None:
        return 0
    checks.integer("--seed", arguments.seed, least=0, most=2**32 - 1, error=ConfigError)
    if not arguments.starts:
        why = "which has no effect without --starts"
        raise ConfigError(message("--seed", arguments.seed, "with --starts", why=why))
    return arguments.seed


def _chosen(run: Run, arguments: argparse.Namespace) -> list[Elite]:
    """Returns the elites that the arguments name."""
    if arguments.cell is not None:
        return [run.elite(arguments.cell)]
    if arguments.near is not None:
        return run.nearest(arguments.near)
    count = len(run.cells) if arguments.best is None else arguments.best
    return run.best(count) if count else []


def _print_repeated(
    run: Run, elites: Sequence[Elite], found: Evaluation, whole: bool
) -> int:
    """Prints results from the start state of the run. Returns the exit code."""
    import numpy as np

    stored = np.asarray([elite.fitness for elite in elites], found.fitnesses.dtype)
    places = np.asarray([elite.descriptor for elite in elites])
    same = (stored == found.fitnesses) & (places == found.descriptors).all(axis=1)
    shown = np.flatnonzero(~same) if whole else np.arange(len(elites))
    rows: list[tuple[Any, ...]] = [
        (
            elites[i].cell,
            _text(found.descriptors[i]),
            f"{stored[i]:.6g}",
            f"{found.fitnesses[i]:.6g}",
            "yes" if same[i] else "no",
        )
        for i in shown[:_MOST_SHOWN]
    ]
    if rows:
        print_table(
            ("cell", "descriptor", "in the archive", "fitness", "same bits"), rows
        )
    if len(shown) > _MOST_SHOWN:
        print(f"... and {len(shown) - _MOST_SHOWN} more")
    count = "1 elite" if len(elites) == 1 else f"{len(elites)} elites"
    if run.config.new_starts and not same.all():
        say(
            f"{count} of {run.path}: each generation had start states of its own, so "
            f"{len(same) - same.sum()} have other results"
        )
        return OK
    if same.all():
        say(f"{count} of {run.path}: fitness and descriptor are bitwise the same")
        return OK
    say(f"{count} of {run.path}: {len(same) - same.sum()} have other results")
    return FAILED


def _print_starts(
    run: Run, elites: Sequence[Elite], found: Evaluation, whole: bool
) -> None:
    """Prints results from several start states, of chosen elites or the whole run."""
    import numpy as np

    median = np.median(found.fitnesses, axis=1)
    # after a fault, a fitness is -inf, from which no finite deviation exists
    spread = [
        row.std() if np.isfinite(row).all() else np.inf for row in found.fitnesses
    ]
    middle = np.median(found.descriptors, axis=1)
    rows = [
        (
            elite.cell,
            _text(elite.descriptor),
            _text(middle[i]),
            f"{elite.fitness:.6g}",
            f"{median[i]:.6g}",
            f"{found.fitnesses[i].min():.6g}",
            f"{spread[i]:.3g}",
        )
        for i, elite in enumerate(elites[:_MOST_SHOWN])
    ]
    head = ("cell", "descriptor", "again", "fitness", "again", "worst", "deviation")
    print_table(head, rows)
    if len(elites) > _MOST_SHOWN:
        print(f"... and {len(elites) - _MOST_SHOWN} more")
    starts, lost = found.fitnesses.shape[1], _lost(elites, median)
    over = "all elites" if whole else f"these {len(elites)} elites"
    text = f"again: medians over {starts} start state{'s' if starts > 1 else ''}"
    if len(elites) > 1:
        text += f"; their median over {over} is {np.median(median):.6g}"
        if not run.config.scatter:
            text += f", {lost:.0%} lost more than a tenth of their fitness"
    say(text)
    if run.config.scatter:
        say("fitness: with the price of scatter; again: without it")


def _lost(elites: Sequence[Elite], medians: Any) -> float:
    """Returns the share of elites with a median a tenth below their fitness."""
    lost = [
        median < elite.fitness - 0.1 * abs(elite.fitness)
        for elite, median in zip(elites, medians, strict=True)
    ]
    return sum(lost) / len(lost)


def _text(descriptor: Any) -> str:
    return " ".join(f"{value:.4g}" for value in descriptor)


def plot(arguments: argparse.Namespace, task_factory: TaskFactory = None) -> int:
    """Writes the pictures of a run. Returns the exit code."""
    folder = arguments.folder
    out, why = folder if arguments.out is None else arguments.out, ""
    if out.exists() and not out.is_dir():
        why = "a file"
    elif holds_run(out) and folder.exists() and not out.samefile(folder):
        why = "the folder of another run, which has a picture of its own"
    if why:
        refused = message("--out", Fact(str(out)), "a folder, or a new name", why=why)
        return complain(arguments, refused, BAD_ARGUMENTS)
    run = opened(folder, task_factory)
    out.mkdir(parents=True, exist_ok=True)
    for name, figure in (
        ("archive.png", run.plot()),
        ("curves.png", run.plot_curves()),
    ):
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=120)
        write_atomically(out / name, buffer.getvalue())
        print(f"written: {out / name}")
    return OK
