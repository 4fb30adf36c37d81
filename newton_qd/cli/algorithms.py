"""``newton-qd algorithms``: lists the algorithms of ``evolve``, or their options."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Iterable, Iterator
from typing import Any

from newton_qd.cli import modules
from newton_qd.cli.arguments import OK, Commands, terminal_width
from newton_qd.qd.algorithms import AlgorithmSpec, algorithm_named, algorithms
from newton_qd.qd.algorithms.options import option_texts


def add_parser(commands: Commands) -> None:
    """Adds the command to the subparsers of ``newton-qd``."""
    parser = commands.add_parser(
        "algorithms",
        help="list the algorithms of evolve, or the options of one",
        description="Lists the algorithms of evolve. With ALGORITHM, lists the "
        "options of this one, with their defaults; evolve takes them as --option "
        "NAME=VALUE.",
    )
    parser.add_argument(
        "name",
        nargs="?",
        metavar="ALGORITHM",
        help="algorithm, for example me-gradient",
    )
    modules.add_argument(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Prints the algorithms, or the options of one algorithm.

    Returns the exit code.

    Raises:
        ConfigError: No algorithm has this name.
    """
    if arguments.name is None:
        print("\n".join(_columns((spec.name, _plain(spec)) for spec in algorithms())))
    else:
        print("\n".join(details(algorithm_named(arguments.name))))
    return OK


def _plain(spec: AlgorithmSpec[Any]) -> str:
    """Returns the summary without backticks."""
    return spec.summary.replace("`", "")


def details(spec: AlgorithmSpec[Any]) -> Iterator[str]:
    """Yields the lines that describe an algorithm and its options."""
    yield from textwrap.wrap(f"{spec.name}: {_plain(spec)}", terminal_width())
    rows = [
        (f"{name}={default}" if default else name, meaning.replace("``", ""))
        for name, default, meaning in option_texts(spec.options)
    ]
    if not rows:
        yield "It has no options of its own."
        return
    yield "\noptions, with their defaults:"
    yield from _columns(rows)
    if spec.tuned:
        yield "\ndefaults that differ for an environment:"
        yield from _columns(
            (env_name, " ".join(f"{name}={value}" for name, value in tuned.items()))
            for env_name, tuned in spec.tuned.items()
        )


def _columns(rows: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Yields the lines of a table with two columns. The second column is wrapped."""
    rows = list(rows)
    width = max(len(head) for head, _ in rows)
    for head, text in rows:
        yield from textwrap.wrap(
            f"  {head.ljust(width)}  {text}",
            max(terminal_width(), width + 34),
            subsequent_indent=" " * (width + 4),
            break_on_hyphens=False,
        )
