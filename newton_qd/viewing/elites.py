"""Trajectories of the elites of a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.viewing.html import short
from newton_qd.viewing.recording import Recorder
from newton_qd.viewing.trajectory import Trajectory, joined

if TYPE_CHECKING:
    from newton_qd.qd.run.opened import Run

_BATCH = 64  # elites that are recorded together


def record_elites(
    run: Run,
    cells: Sequence[int] | np.ndarray,
    *,
    steps: int | None = None,
    contacts: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Trajectory:
    """Records elites of a run, each from the start of the run's evaluations.

    If an evaluation of the run has several start states, it is the first of them.

    Args:
        run: The run, from ``newton_qd.qd.load_run(DIR)``.
        cells: (N,) rows of the archive, with at least one; or a row.
        steps: Control steps, up to the episode length of the run; ``None``: all.
        contacts: Whether to record the impulse of every contact.
        progress: Called after each batch with the number of recorded elites and N.

    Raises:
        TypeError: The environment cannot be drawn.
        ValueError: There are no cells, or ``steps`` is not allowed.
        IndexError: A cell does not exist.
        LookupError: A cell is empty.
    """
    elites = [run.elite(cell) for cell in np.atleast_1d(np.asarray(cells)).tolist()]
    length = run.config.episode_length
    checks.integer("steps", steps, optional=True)
    if steps is not None and steps > length:
        allowed = f"None, or integers from 1 to {length}, the length of an episode"
        raise ValueError(message("steps", steps, f"{allowed} of the run"))
    steps = length if steps is None else steps
    from newton_qd.qd.scoring.robust import start_keys

    start = start_keys(run.start_key, run.config.starts)[0]
    policy = run.policy
    record = Recorder(run.task.env, policy.apply, steps, contacts=contacts)
    unravel = jax.jit(jax.vmap(policy.unravel))
    size = min(_BATCH, max(1, len(elites)))
    parts = []
    for begin in range(0, len(elites), size):
        some = elites[begin : begin + size]
        # the last batch is as large as the others, so that it needs no compiling
        filled = [*some, *[some[-1]] * (size - len(some))]
        genotypes = jnp.asarray(np.stack([elite.genotype for elite in filled]))
        labels = [f"cell {e.cell}, fitness {short(e.fitness)}" for e in filled]
        part = record(unravel(genotypes), start, labels)
        parts.append(part.select(list(range(len(some)))))
        if progress is not None:
            progress(min(begin + size, len(elites)), len(elites))
    return joined(parts)
