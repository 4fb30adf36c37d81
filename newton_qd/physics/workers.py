"""Threads that take a share of a CPU launch.

A launch lasts some hundred microseconds, about as long as an idle core needs to wake
up. So a worker looks for its next job for a moment before it sleeps, as OpenMP's
threads do; a scan over control steps then finds it awake.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from typing import TypeVar, TypeVarTuple

_AWAKE_SECONDS = 1e-3

Job = tuple[Callable[..., None], tuple[object, ...]]
Item = TypeVar("Item")
Arguments = TypeVarTuple("Arguments")


def _take(source: queue.SimpleQueue[Item]) -> Item:
    """Next item: looked for at once, then waited for."""
    deadline = time.perf_counter() + _AWAKE_SECONDS
    while time.perf_counter() < deadline:
        try:
            return source.get_nowait()
        except queue.Empty:
            time.sleep(0)  # lets other threads run Python
    return source.get()


class Worker:
    """One daemon thread that runs jobs in order."""

    def __init__(self, name: str) -> None:
        self._jobs: queue.SimpleQueue[Job] = queue.SimpleQueue()
        self._ends: queue.SimpleQueue[BaseException | None] = queue.SimpleQueue()
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def _run(self) -> None:
        while True:
            function, arguments = _take(self._jobs)
            error: BaseException | None = None
            try:
                function(*arguments)
            except BaseException as raised:  # handed to the thread that waits
                error = raised
            # nothing of the job may outlive it while this thread waits
            del function, arguments
            self._ends.put(error)

    def start(
        self, function: Callable[[*Arguments], None], *arguments: *Arguments
    ) -> None:
        """Begin a job."""
        self._jobs.put((function, arguments))

    def wait(self) -> None:
        """Wait for the job's end.

        Raises:
            BaseException: What the job raised.
        """
        error = _take(self._ends)
        if error is not None:
            raise error
