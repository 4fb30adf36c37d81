"""Keeping Ctrl-C out of the callbacks that XLA makes into Python.

A ``KeyboardInterrupt`` that is raised while XLA waits for a callback is lost at
best, because no exception passes through XLA's frames, and leaves outputs unwritten
at worst. So while a callback is on the stack the interrupt is put off, and sent again
until it arrives between two computations.
"""

from __future__ import annotations

import queue
import signal
import threading
import time
from collections.abc import Callable
from types import CodeType, FrameType

_RETRY_SECONDS = 0.02
_protected: set[CodeType] = set()
_files: set[str] = set()
# Written by the signal handler, which may interrupt anything, itself included: the
# put of a SimpleQueue is made for that, starting a thread or setting an Event is not.
_put_off: queue.SimpleQueue[None] = queue.SimpleQueue()
_pending = False
_sender: threading.Thread | None = None


def protect(function: Callable) -> None:
    """Put interrupts off while ``function`` is running.

    Whatever is defined inside a function of the same file counts as well: ctypes may
    enter Python through a closure that calls ``function``, and an interrupt on the
    first line of that closure is as bad.

    Args:
        function: A Python function whose frame marks a callback.
    """
    _protected.add(function.__code__)
    _files.add(function.__code__.co_filename)


def _inside_callback(frame: FrameType | None) -> bool:
    while frame is not None:
        code = frame.f_code
        if code in _protected:
            return True
        if code.co_filename in _files and "<locals>" in code.co_qualname:
            return True
        frame = frame.f_back
    return False


def _send_again() -> None:
    global _pending
    while True:
        _put_off.get()
        time.sleep(_RETRY_SECONDS)
        if _pending:
            _pending = False
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)


def _on_interrupt(signum: int, frame: FrameType | None) -> None:
    global _pending
    if not _inside_callback(frame):
        _pending = False
        signal.default_int_handler(signum, frame)
    elif not _pending:
        # however often the user asks meanwhile, one interrupt arrives
        _pending = True
        _put_off.put(None)


def install() -> None:
    """Handle SIGINT as above, unless the program has a handler of its own.

    Only Python's default handler is replaced, and only from the main thread; the
    replacement raises ``KeyboardInterrupt`` as the default one does.
    """
    global _sender
    if threading.current_thread() is not threading.main_thread():
        return
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return
    if _sender is None:
        _sender = threading.Thread(
            target=_send_again, name="newton_qd_interrupts", daemon=True
        )
        _sender.start()
    signal.signal(signal.SIGINT, _on_interrupt)
