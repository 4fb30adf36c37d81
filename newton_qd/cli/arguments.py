"""Helpers of all commands: exit codes, error messages, tables, lists of integers."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO, TypeAlias

from newton_qd.checks import message
from newton_qd.qd.config import ConfigError, read_config
from newton_qd.qd.facts import changed_facts, environment_facts
from newton_qd.qd.run.archive import ARCHIVE
from newton_qd.qd.run.folder import CHECKPOINT, CONFIG
from newton_qd.qd.run.interrupt import graceful_stop
from newton_qd.qd.run.progress import for_stream

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
"""The subparsers of ``newton-qd``."""

OK, FAILED, BAD_ARGUMENTS = 0, 1, 2


def complain(arguments: argparse.Namespace, what: object, code: int) -> int:
    """Prints an error of the command to standard error and returns the exit code."""
    say(f"newton-qd {arguments.command}: error: {what}", sys.stderr)
    return code


def say(text: str, stream: TextIO | None = None) -> None:
    """Prints sentences. A terminal gets line breaks between words.

    Args:
        text: One or more lines.
        stream: Where to; ``None``: standard output. Only there, a reader that has left
            ends the command.

    Raises:
        BrokenPipeError: Nobody reads the standard output any more.
    """
    target: TextIO = sys.stdout if stream is None else stream
    try:
        print(for_stream(text, target), file=target)
    except BrokenPipeError:
        if stream is None:
            raise
        abandon(target)


def abandon(stream: TextIO) -> None:
    """Sends what is still written to a stream nowhere, because its reader has left.

    Python would complain at its end, when it flushes what nobody reads.
    """
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def warn_of_changes(facts: dict[str, object], when: str) -> None:
    """Says on standard error which facts of a machine differ from those of this one.

    Args:
        facts: Facts from a config; empty: nothing is known.
        when: When they held.
    """
    for name, old, new in changed_facts(facts, environment_facts()) if facts else ():
        say(
            f"warning: {name} was {old} {when} and is {new} now; the result may differ",
            sys.stderr,
        )


def holds_run(folder: Path) -> bool:
    """Returns whether a folder holds a run, also one of another version.

    Other programs have files of the name ``config.json`` too.
    """
    if not (folder / CONFIG).is_file():
        return False
    if any((folder / name).is_file() for name in (CHECKPOINT, ARCHIVE)):
        return True
    try:
        read_config(folder / CONFIG)  # of a run that has just begun
    except ConfigError:
        return False
    return True


def require_writable(name: str, path: Path) -> None:
    """Checks that a file or folder can be made or replaced, before the slow part.

    Args:
        name: Name of the argument.
        path: The file or folder, which need not exist.

    Raises:
        ConfigError: Its folder cannot be written.
    """
    places = (path.absolute(), *path.absolute().parents)
    found = next(place for place in places if os.path.lexists(place))
    if found == places[0] and not found.is_dir():
        found = found.parent  # a file is replaced by another one of its folder
    if not found.is_dir() or not os.access(found, os.W_OK | os.X_OK):
        why = f"and {found} cannot be written"
        raise ConfigError(message(name, str(path), "a place that can be", why=why))


def load_physics() -> None:
    """Imports JAX and the physics. From then on, Ctrl-C ends a command at any moment.

    Python drops an interrupt that arrives in a callback of JAX while it collects
    garbage; the handler of the physics delays it. An interrupt during the import of an
    extension module can crash Python, so it waits for the end of the imports.

    Raises:
        KeyboardInterrupt: A signal arrived during the imports.
    """
    with graceful_stop(b"\nstopping\n") as stop:
        from newton_qd.physics import interrupts
    if stop.requested:
        raise KeyboardInterrupt
    interrupts.install()


def terminal_width() -> int:
    """Returns the columns of a table for the terminal: 79, or fewer if it is narrow."""
    return max(24, min(79, shutil.get_terminal_size().columns - 1))


def print_table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Prints rows below a head."""
    lines = [head, *rows]
    sizes = [max(len(str(row[i])) for row in lines) for i in range(len(head))]
    for row in lines:
        cells = (str(cell).ljust(size) for cell, size in zip(row, sizes, strict=True))
        print("  ".join(cells).rstrip())


def widths(text: str) -> tuple[int, ...]:
    """Parses integers with commas between them. The word ``none`` means no integers."""
    return () if text == "none" else integers(text, ",")


def integers(text: str, separator: str) -> tuple[int, ...]:
    """Parses integers with separators between them.

    Raises:
        argparse.ArgumentTypeError: A part is not an integer.
    """
    try:
        return tuple(int(part) for part in text.split(separator))
    except ValueError as error:
        example = separator.join(("8", "8"))
        given = f"got {text!r}; allowed: integers like {example}"
        raise argparse.ArgumentTypeError(given) from error


def picture_size(text: str) -> tuple[int, int]:
    """Parses a width and a height.

    Raises:
        argparse.ArgumentTypeError: The text is not two integers from 16 to 4096.
    """
    try:
        size = integers(text, "x")
    except argparse.ArgumentTypeError:
        size = ()
    if len(size) != 2 or not all(16 <= each <= 4096 for each in size):
        given = f"got {text!r}; allowed: two integers from 16 to 4096, like 480x360"
        raise argparse.ArgumentTypeError(given)
    return size[0], size[1]


def numbers(text: str) -> tuple[float, ...]:
    """Parses numbers with commas between them.

    Raises:
        argparse.ArgumentTypeError: A part is not a number.
    """
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        given = f"got {text!r}; allowed: numbers like 0.5,0.25"
        raise argparse.ArgumentTypeError(given) from error


def add_elite_choice(parser: argparse.ArgumentParser, best: str) -> None:
    """Adds the arguments that name elites of a run.

    Args:
        parser: Parser of a command.
        best: Help of ``--best``.
    """
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--cell", type=int, metavar="N", help="the elite of one cell")
    which.add_argument("--best", type=int, metavar="N", help=best)
    which.add_argument(
        "--near",
        type=numbers,
        metavar="X,X",
        help="the elite with the nearest descriptor; write --near=-3,2 if the first "
        "number is negative",
    )
