"""Keeps Ctrl-C out of the callbacks from XLA into Python.

No exception passes through XLA's frames. A ``KeyboardInterrupt`` inside a callback is
therefore lost, and the outputs of the callback may stay unwritten. While a callback is
on the stack, this module delays the interrupt. It sends the signal again until the
signal arrives between two computations.
"""

from __future__ import annotations

import queue
import signal
import threading
import time
from collections.abc import Callable
from types import CodeType, FrameType

_RETRY_SECONDS = 0.02
# JAX runs this function while Python collects garbage. Python drops its exceptions.
_SWALLOWING = ("_xla_gc_callback",)
_protected: set[CodeType] = set()
_files: set[str] = set()
# The signal handler writes to this queue. The handler may interrupt any code, including
# itself. SimpleQueue.put is safe in this case. Starting a thread or setting an Event is
# not.
_put_off: queue.SimpleQueue[None] = queue.SimpleQueue()
_pending = False
_sender: threading.Thread | None = None


def protect(function: Callable) -> None:
    """Delay interrupts while ``function`` is running.

    Functions that are defined inside a function of the same file are protected too.
    The reason: ctypes may enter Python through a closure that calls ``function``. An
    interrupt on the first line of that closure would do the same harm.

    Args:
        function: Python function. Its frame on the stack marks a callback.
    """
    _protected.add(function.__code__)
    _files.add(function.__code__.co_filename)


def _inside_callback(frame: FrameType | None) -> bool:
    while frame is not None:
        code = frame.f_code
        if code in _protected or code.co_name in _SWALLOWING:
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
        # Several Ctrl-C during one callback become one interrupt.
        _pending = True
        _put_off.put(None)


def install() -> None:
    """Install the SIGINT handler of this module.

    It replaces Python's default handler only. A handler that the program installed
    stays. Outside the main thread the function does nothing. The new handler raises
    ``KeyboardInterrupt``, as the default handler does.
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
