"""Keeping Ctrl-C out of the callbacks that XLA makes into Python.

A ``KeyboardInterrupt`` that is raised while XLA waits for a callback is lost at
best, because no exception passes through XLA's frames, and leaves outputs unwritten
at worst. So while a callback is on the stack the interrupt is put off, and sent again
until it arrives between two computations.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import CodeType, FrameType

_RETRY_SECONDS = 0.02
_protected: set[CodeType] = set()
_retry: threading.Timer | None = None


def protect(function: Callable) -> None:
    """Put interrupts off while ``function`` is running.

    Args:
        function: A Python function whose frame marks a callback.
    """
    _protected.add(function.__code__)


def _inside_callback(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code in _protected:
            return True
        frame = frame.f_back
    return False


def _send_again() -> None:
    global _retry
    _retry = None
    signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)


def _on_interrupt(signum: int, frame: FrameType | None) -> None:
    global _retry
    if not _inside_callback(frame):
        signal.default_int_handler(signum, frame)
    elif _retry is None:
        _retry = threading.Timer(_RETRY_SECONDS, _send_again)
        _retry.daemon = True
        _retry.start()


def install() -> None:
    """Handle SIGINT as above, unless the program has a handler of its own.

    Only Python's default handler is replaced, and only from the main thread; the
    replacement raises ``KeyboardInterrupt`` as the default one does.
    """
    if threading.current_thread() is not threading.main_thread():
        return
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _on_interrupt)
