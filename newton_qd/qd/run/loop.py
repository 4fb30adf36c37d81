"""The loop over generations, with checkpoints between them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

from newton_qd.qd.run.folder import COLUMNS, RunFolder
from newton_qd.qd.run.interrupt import StopFlag
from newton_qd.qd.run.search import Search, SearchState

_WAIT = 19.0
"""Shortest time between checkpoints, as a multiple of the time that one takes: so they
take at most a twentieth of a run."""


class Saver:
    """Writes checkpoints, with a shortest time between them."""

    def __init__(
        self, search: Search, folder: RunFolder | None, least_seconds: float
    ) -> None:
        """Begins with nothing saved.

        Args:
            search: Search that makes the checkpoints.
            folder: Folder of the checkpoints; ``None``: nothing is saved.
            least_seconds: Shortest time between two checkpoints [s]. It becomes longer
                if a checkpoint takes long; 0: one after each generation.
        """
        self._search = search
        self._folder = folder
        self._least_seconds = least_seconds
        self._wait = least_seconds
        self._saved_at = time.monotonic()

    def sometimes(self, state: SearchState) -> None:
        """Saves if the last checkpoint is old enough."""
        if time.monotonic() - self._saved_at >= self._wait:
            self.now(state)

    def now(self, state: SearchState) -> None:
        """Saves, if there is a state and a folder."""
        begin = time.monotonic()
        if self._folder is not None and state.iteration >= 0:
            self._folder.save(self._search.checkpoint(state))
        self._saved_at = time.monotonic()
        if self._least_seconds:
            took = self._saved_at - begin
            self._wait = max(self._least_seconds, _WAIT * took)


def run_generations(
    search: Search,
    state: SearchState,
    iterations: int,
    watchers: Iterable[Callable[[int, dict[str, float]], None]],
    stop: StopFlag,
    save: Saver,
) -> SearchState:
    """Runs until the last generation, a signal or an error, and saves.

    Args:
        search: Search that makes the generations.
        state: State to begin with.
        iterations: The last generation.
        watchers: Called with number and metrics of each generation.
        stop: Flag that a signal sets.
        save: Writes the checkpoints.

    Returns:
        The last state.

    Raises:
        SearchError: No individual of the initial population has finite scores.
    """
    while state.iteration < iterations and not stop.requested:
        try:
            state = search.advance(state)
            values = state.metrics[-1]
            row: dict[str, float] = dict(zip(COLUMNS, values, strict=True))
            for watch in watchers:
                watch(state.iteration, row)
        except Exception:
            save.now(state)  # of the last whole generation
            raise
        save.sometimes(state)
    save.now(state)
    return state
