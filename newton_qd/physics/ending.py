"""Ends the physics that is in flight when the program ends.

XLA would wait for it, and its results are lost anyway. A daemon thread must not be
inside XLA when Python ends: Python then stops it with an exception that C++ cannot
handle, and the program aborts.
"""

from __future__ import annotations

import atexit
import queue
import selectors
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import jax

from newton_qd.physics import interrupts

_JAX = str(Path(jax.__file__).parent)
_IDLE = {module.__file__ for module in (threading, queue, selectors, interrupts)}
_QUIET_SECONDS = 0.1  # without a call: no program in flight is left
_BEGINNING_SECONDS = 1.0  # the same, if a thread has just begun a program
_LEAVING_SECONDS = 10.0


def stop_at_exit(
    stop: Callable[[], None], stopped: Callable[[], int], *, in_python: bool
) -> None:
    """Stops physics in flight before Python ends.

    Programs with effects, such as ``jax.debug.print``, run to their end.

    Args:
        stop: Lets physics in flight, and all later physics, end with an error.
        stopped: Returns the number of calls that ended with this error.
        in_python: Whether the physics calls Python, also in threads of XLA.
    """
    atexit.register(_stop, stop, stopped, in_python)


def _stop(
    stop: Callable[[], None], stopped: Callable[[], int], in_python: bool
) -> None:
    """Stops the physics, and waits until other threads have left XLA."""
    jax.effects_barrier()
    before = _places()
    stop()
    if not before and not in_python:
        return
    calls, traced = stopped(), False
    begin = last = time.monotonic()  # last: of the last sign of a program in flight
    while time.monotonic() < begin + _LEAVING_SECONDS:
        time.sleep(_QUIET_SECONDS)
        places = _places()
        traces = any(_in_jax(frame) for frame, _ in places.values())
        traced |= traces
        if traces or stopped() != calls:
            calls, last = stopped(), time.monotonic()
        # a thread that has not moved may still be inside XLA
        inside = (traced or calls > 0) and before.items() & places.items()
        # XLA may run a program in a thread of its own. Its first call comes later.
        # Python must not end before it: XLA would wait for the call, and the call for
        # Python.
        quiet = _BEGINNING_SECONDS if traced and in_python else _QUIET_SECONDS
        if not inside and time.monotonic() >= last + quiet:
            break


def _places() -> dict[int, tuple[FrameType, int]]:
    """Returns where other threads are in Python, by their number; not of idle ones."""
    own = threading.get_ident()
    return {
        name: (frame, frame.f_lasti)
        for name, frame in sys._current_frames().items()
        if name != own and frame.f_code.co_filename not in _IDLE
    }


def _in_jax(frame: FrameType) -> bool:
    """Returns whether a thread traces or compiles a program."""
    return any(x.f_code.co_filename.startswith(_JAX) for x in _stack(frame))


def _stack(frame: FrameType | None) -> Iterator[FrameType]:
    while frame is not None:
        yield frame
        frame = frame.f_back
