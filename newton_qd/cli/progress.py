"""A line of progress for commands that write pages and pictures."""

from __future__ import annotations

import contextlib
import sys
import time
from types import TracebackType


class ProgressCount:
    """Shows how many of a number of things are done, on standard error.

    On a terminal it is one line that changes. Elsewhere nothing is shown before ten
    seconds have passed.
    """

    def __init__(self, what: str) -> None:
        """Begins with nothing done.

        Args:
            what: Plural of what is counted.
        """
        self.what = what
        self._terminal = sys.stderr.isatty()
        self._next = time.monotonic() + (0.0 if self._terminal else 10.0)

    def __enter__(self) -> ProgressCount:
        return self

    def __call__(self, done: int, total: int) -> None:
        """Shows progress, not more often than is useful.

        Args:
            done: Number of things that are done.
            total: Number of all things.
        """
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + (0.2 if self._terminal else 10.0)
        text = f"{done} of {total} {self.what}"
        self._write(text + ("\r" if self._terminal else "\n"))

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Clears the line."""
        del kind, error, trace
        if self._terminal:
            self._write("\x1b[2K")

    def _write(self, text: str) -> None:
        """Writes text. If nobody can read it, the command goes on."""
        with contextlib.suppress(OSError):
            print(end=text, file=sys.stderr, flush=True)
