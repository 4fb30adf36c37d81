"""Worker threads for CPU launches.

A launch takes a few hundred microseconds. An idle core needs about as long to wake up.
A worker therefore polls for its next job for a short time before it sleeps, as the
threads of OpenMP do. In a scan over control steps it then stays awake.
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
    """Returns the next item. It polls for a short time, then blocks."""
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
            except BaseException as raised:  # the waiting thread raises it
                error = raised
            # Free the job's objects before this thread waits for the next job.
            del function, arguments
            self._ends.put(error)

    def start(
        self, function: Callable[[*Arguments], None], *arguments: *Arguments
    ) -> None:
        """Start a job."""
        self._jobs.put((function, arguments))

    def wait(self) -> None:
        """Wait for the end of the job.

        Raises:
            BaseException: The exception that the job raised.
        """
        error = _take(self._ends)
        if error is not None:
            raise error
