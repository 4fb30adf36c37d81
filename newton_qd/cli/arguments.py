"""What the commands share: exit codes, complaints, and lists of integers."""

from __future__ import annotations

import argparse
import sys

OK, FAILED, BAD_ARGUMENTS = 0, 1, 2


def complain(arguments: argparse.Namespace, what: object, code: int) -> int:
    """Prints an error of the command to the terminal and returns its exit code."""
    print(f"newton-qd {arguments.command}: error: {what}", file=sys.stderr)
    return code


def widths(text: str) -> tuple[int, ...]:
    """Integers between commas; none for the word none."""
    return () if text == "none" else integers(text, ",")


def integers(text: str, separator: str) -> tuple[int, ...]:
    """Integers between separators.

    Raises:
        argparse.ArgumentTypeError: A part is not an integer.
    """
    try:
        return tuple(int(part) for part in text.split(separator))
    except ValueError as error:
        example = separator.join(("8", "8"))
        raise argparse.ArgumentTypeError(
            f"expected integers like {example}, got {text!r}"
        ) from error
