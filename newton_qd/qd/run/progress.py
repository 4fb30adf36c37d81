"""Progress of an evolution: one redrawn line on a terminal, plain lines elsewhere.

A finished run has one line as well.
"""

from __future__ import annotations

import shutil
import sys
import textwrap
import time
from collections.abc import Mapping
from typing import TextIO

import numpy as np

from newton_qd.qd.config import EvolveConfig

_PLAIN_SECONDS = 10.0
_REDRAW_SECONDS = 0.1
_BAR_WIDTH = 20
_LONG_SECONDS = 60.0  # a run whose time is worth an estimate of its own
_COMPILING_UPDATES = 2  # first updates compile, so their time is not typical


def for_stream(text: str, stream: TextIO) -> str:
    """Returns text with line breaks between words, if a terminal would break words.

    Other streams get the text as it is, so that scripts find whole sentences.

    Args:
        text: One or more lines.
        stream: Where the text will be written.
    """
    if not stream.isatty():
        return text
    columns = shutil.get_terminal_size().columns
    lines = (
        textwrap.fill(line, columns, break_long_words=False, break_on_hyphens=False)
        for line in text.split("\n")
    )
    return "\n".join(lines)


class Progress:
    """Shows the progress of a run and its metrics.

    Attributes:
        total: Generations of the whole run.
    """

    def __init__(
        self,
        name: str,
        total: int,
        *,
        stream: TextIO | None = None,
        enabled: bool = True,
    ) -> None:
        """Prepares the display; shows nothing yet.

        Args:
            name: Label at the beginning of every line.
            total: Generations of the whole run.
            stream: Stream for the text; by default standard error.
            enabled: Whether to show anything.
        """
        self.total = total
        self._name = name
        self._stream = sys.stderr if stream is None else stream
        self._enabled = enabled
        self._tty = enabled and self._stream.isatty()
        self._begin = time.monotonic()
        self._updates = 0
        self._paced_from = (0, self._begin)
        self._shown_at = -float("inf")
        self._open_line = False

    def note(self, text: str) -> None:
        """Writes one plain line, below the bar if there is one."""
        if not self._enabled:
            return
        self.close()
        self._write(for_stream(text, self._stream) + "\n")

    def update(self, iteration: int, row: dict[str, float]) -> None:
        """Shows the state after a generation.

        Args:
            iteration: Generations that are finished.
            row: Metrics with ``qd_score``, ``coverage`` [%], ``max_fitness``.
        """
        if not self._enabled:
            return
        now = time.monotonic()
        self._updates += 1
        if self._updates <= _COMPILING_UPDATES:
            self._paced_from = (iteration, now)
        if self._updates == _COMPILING_UPDATES + 1:
            self._estimate(iteration, now)
        pause = _REDRAW_SECONDS if self._tty else _PLAIN_SECONDS
        if now - self._shown_at < pause and iteration < self.total:
            return
        self._shown_at = now
        text = self._line(iteration, row, now)
        if self._tty:
            self._write("\r" + text + "\x1b[K")
            self._open_line = True
        else:
            self._write(text + "\n")

    def _estimate(self, iteration: int, now: float) -> None:
        """Says once how long the run will take, if it is long."""
        first, since = self._paced_from
        each = (now - since) / max(1, iteration - first)
        left = (self.total - iteration) * each
        if left >= _LONG_SECONDS:
            self.note(
                f"a generation takes about {each:.2g} s: {_clock(left)} for the "
                f"{self.total - iteration} that are left"
            )

    def close(self) -> None:
        """Ends the redrawn line so that later text starts on its own line."""
        if self._open_line:
            self._write("\n")
            self._open_line = False

    def _line(self, iteration: int, row: dict[str, float], now: float) -> str:
        fraction = iteration / self.total if self.total else 1.0
        first, since = self._paced_from
        left = None
        if iteration > first:
            left = (self.total - iteration) * (now - since) / (iteration - first)
        head = f"{self._name} {fraction:4.0%}"
        fields = [
            f"{iteration}/{self.total}",
            f"QD score {row['qd_score']:,.0f}",
            f"coverage {row['coverage']:.1f}%",
            f"best {row['max_fitness']:.1f}",
            f"{_clock(now - self._begin)}<{_clock(left)}",
        ]
        if not self._tty:
            return "  ".join([head, *fields])
        # One column stays free, because a full line would wrap on some terminals.
        columns = shutil.get_terminal_size().columns - 1
        while len(fields) > 2 and len("  ".join([head, *fields])) > columns:
            del fields[-2]  # a number that is cut would be another number
        room = columns - len("  ".join([head, *fields])) - 1
        bar = f" {self._bar(fraction, min(room, _BAR_WIDTH))}" if room > 4 else ""
        return "  ".join([f"{head}{bar}", *fields])[:columns]

    def _bar(self, fraction: float, width: int) -> str:
        filled = round(fraction * width)
        encoding = (self._stream.encoding or "ascii").lower()
        full, empty = ("█", "░") if "utf" in encoding else ("#", ".")
        return full * filled + empty * (width - filled)

    def _write(self, text: str) -> None:
        """Writes text. If nobody can read it, the display ends, but not the run."""
        if not self._enabled:
            return
        try:
            self._stream.write(text)
            self._stream.flush()
        except OSError:  # as in: newton-qd evolve ant_uni 2>&1 | head
            self._enabled = False


def results_text(config: EvolveConfig, metrics: Mapping[str, np.ndarray]) -> str:
    """Returns what a run is and what it has found, in one line.

    Args:
        config: Its settings.
        metrics: Name of each column of ``metrics.csv`` to its values.
    """
    run = f"{config.algorithm} on {config.env_name}"
    if not len(metrics.get("iteration", ())):
        return run
    last = {name: values[-1] for name, values in metrics.items()}
    return (
        f"{run}, {last['iteration']:.0f} generations, "
        f"QD score {last['qd_score']:,.0f}, coverage {last['coverage']:.1f} %, "
        f"best fitness {last['max_fitness']:,.1f}"
    )


def _clock(seconds: float | None) -> str:
    """Formats a duration [s] as minutes and seconds."""
    if seconds is None:
        return "-:--"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours}:{minutes:02d}:{rest:02d}"
    return f"{minutes}:{rest:02d}"
