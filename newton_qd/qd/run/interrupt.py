"""Ctrl-C and SIGTERM as a flag for long loops.

A signal could raise an exception inside a callback of the physics. The exception could
be lost there, or could end the interpreter. A flag avoids this.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType

INTERRUPTED = 130
"""Exit code of a run that ended by a signal, as in shells."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_NOTICE = b"\nstopping after this generation, then saving (a second signal quits now)\n"


@dataclasses.dataclass
class StopFlag:
    """The flag: whether a signal has asked the loop to stop."""

    requested: bool = False


@contextlib.contextmanager
def graceful_stop(notice: bytes = _NOTICE) -> Iterator[StopFlag]:
    """Converts SIGINT and SIGTERM to a flag while the block runs.

    A second signal ends the process at once with exit code 130. Python allows handlers
    in the main thread only. In another thread, the flag stays unset. A signal that the
    process ignores stays ignored.

    Args:
        notice: Text that the first signal prints at once.
    """
    flag = StopFlag()
    if threading.current_thread() is not threading.main_thread():
        yield flag
        return

    def handle(number: int, frame: FrameType | None) -> None:
        del number, frame
        flag.requested = True

    previous = {number: signal.getsignal(number) for number in _SIGNALS}
    active = [n for n in _SIGNALS if previous[n] is not signal.SIG_IGN]
    with _answer_at_once(active, notice):
        for number in active:
            signal.signal(number, handle)
        try:
            yield flag
        finally:
            for number in active:
                signal.signal(number, previous[number] or signal.SIG_DFL)


@contextlib.contextmanager
def _answer_at_once(numbers: list[signal.Signals], notice: bytes) -> Iterator[None]:
    """Starts a thread that prints a text at a signal.

    Python runs handlers only between two of its own instructions. During a compilation
    this can take a minute. The thread gets a signal at once.

    Args:
        numbers: Signals.
        notice: Text to print at the first signal.
    """
    reader, writer = os.pipe()
    os.set_blocking(writer, False)

    def listen() -> None:
        seen = 0
        while received := os.read(reader, 1):
            seen += received[0] in numbers
            if seen > 1:
                os._exit(INTERRUPTED)
            if received[0] in numbers:
                # not with sys.stderr, whose buffer may be in use
                with contextlib.suppress(OSError):
                    os.write(2, notice)
        os.close(reader)

    before = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    threading.Thread(target=listen, name="signals", daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        os.close(writer)  # ends the thread
