"""Builds ``handler.cpp`` with Warp's own compiler, and loads it into the process."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import tempfile
import threading
from pathlib import Path

import warp as wp

from newton_qd.physics.cache import keep, kept, kernel_cache
from newton_qd.physics.warp_internals import load_native

_SOURCE = Path(__file__).with_name("handler.cpp")
# Functions of the operating system, in the order of `System` in the source.
_FUNCTIONS = (
    "pthread_create",
    "pthread_mutex_lock",
    "pthread_mutex_unlock",
    "pthread_cond_wait",
    "pthread_cond_signal",
    "sched_yield",
    "getenv",
)
_INITIALIZERS = ("pthread_mutex_init", "pthread_cond_init")


def usable_cores() -> int:
    """Returns the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class _System(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p) for name in _FUNCTIONS),
        ("cores", ctypes.c_int64),
    )


class Library:
    """The functions of ``handler.cpp``.

    Attributes:
        handlers: Address of each function that XLA calls, by its name.
    """

    def __init__(self) -> None:
        """Loads the source. It is compiled once, which takes 0.3 s.

        Raises:
            UnsupportedWarpError: The installed Warp cannot compile it.
        """
        place = _place()
        with tempfile.TemporaryDirectory() as folder:
            target = Path(folder) / "handler.o"
            found = kept(place)
            if found is not None:
                target.write_bytes(found)
            find = load_native(_SOURCE, target)
            if found is None:
                keep(place, target.read_bytes())
        self.handlers = {
            name: find(name) for name in ("newton_qd_rows", "newton_qd_rollout")
        }
        pointer, integer = ctypes.c_void_p, ctypes.c_int64
        self._run = ctypes.CFUNCTYPE(ctypes.c_int, pointer, integer, pointer)(
            find("newton_qd_run")
        )
        self._add = ctypes.CFUNCTYPE(None, pointer)(find("newton_qd_add"))
        self._free = ctypes.CFUNCTYPE(None, pointer)(find("newton_qd_free"))
        self._stop = ctypes.CFUNCTYPE(None)(find("newton_qd_stop"))
        self._stopped = ctypes.CFUNCTYPE(integer)(find("newton_qd_stopped"))
        functions, initializers = _threading_functions()
        system = _System(*functions, usable_cores())
        begin = ctypes.CFUNCTYPE(None, pointer, pointer, pointer)
        begin(find("newton_qd_start"))(ctypes.addressof(system), *initializers)

    def run(self, plan: ctypes.Structure, worlds: int, arrays: list[int]) -> int:
        """Runs a plan on arrays of rows.

        Args:
            plan: The plan.
            worlds: Number of worlds.
            arrays: Addresses of the arrays.

        Returns:
            0, or the code of an error.
        """
        addresses = (ctypes.c_void_p * len(arrays))(*arrays)
        return self._run(ctypes.addressof(plan), worlds, ctypes.addressof(addresses))

    def add(self, plan: ctypes.Structure) -> None:
        """Lets XLA find a plan by its key. The plan must stay in memory."""
        self._add(ctypes.addressof(plan))

    def free(self, plan: ctypes.Structure) -> None:
        """Frees the scratch memory of a plan that nobody runs any more."""
        self._free(ctypes.addressof(plan))

    def stop(self) -> None:
        """Lets all kernels that run, and all later calls, end soon with an error."""
        self._stop()

    def stopped(self) -> int:
        """Returns the number of calls from XLA that ended with this error."""
        return self._stopped()


def _place() -> Path:
    """Returns where the compiled source is kept: next to the compiled kernels."""
    given = (platform.system(), platform.machine(), wp.__version__)
    digest = hashlib.sha256(repr(given).encode() + _SOURCE.read_bytes()).hexdigest()
    return Path(kernel_cache()) / "newton_qd_native" / f"{digest[:32]}.handler"


def _threading_functions() -> tuple[list[int | None], list[int | None]]:
    """Returns addresses in the C library; all are 0 where it lacks one of them.

    Kernels then run in one thread, as on Windows.
    """
    process = ctypes.CDLL(None) if os.name == "posix" else None
    found = [
        [_address(process, name) for name in names]
        for names in (_FUNCTIONS, _INITIALIZERS)
    ]
    if any(address is None for addresses in found for address in addresses):
        return [None] * len(_FUNCTIONS), [None] * len(_INITIALIZERS)
    return found[0], found[1]


def _address(process: ctypes.CDLL | None, name: str) -> int | None:
    if process is None or not hasattr(process, name):
        return None
    return ctypes.cast(getattr(process, name), ctypes.c_void_p).value


_COMPILING = threading.RLock()


def library() -> Library:
    """Returns the functions. The first call compiles them.

    Raises:
        UnsupportedWarpError: The installed Warp cannot compile them.
    """
    with _COMPILING:
        return _library()


@functools.cache
def _library() -> Library:
    return Library()
