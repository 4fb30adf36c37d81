"""Helpers of all commands: exit codes, error messages, lists of integers."""

from __future__ import annotations

import argparse
import sys
from typing import TypeAlias

from newton_qd.qd.config import changed_facts, environment_facts

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
"""The subparsers of ``newton-qd``."""

OK, FAILED, BAD_ARGUMENTS = 0, 1, 2


def complain(arguments: argparse.Namespace, what: object, code: int) -> int:
    """Prints an error of the command to standard error and returns the exit code."""
    print(f"newton-qd {arguments.command}: error: {what}", file=sys.stderr)
    return code


def warn_of_changes(facts: dict[str, object], when: str) -> None:
    """Says on standard error which facts of a machine differ from those of this one.

    Args:
        facts: Facts from a config; empty: nothing is known.
        when: When they held.
    """
    for name, old, new in changed_facts(facts, environment_facts()) if facts else ():
        print(
            f"warning: {name} was {old} {when} and is {new} now; the result may differ",
            file=sys.stderr,
        )


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
