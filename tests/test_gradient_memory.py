"""What gradients of episodes keep in memory, as XLA allocates it; nothing is run."""

from __future__ import annotations

import functools
from typing import Any

import jax
import numpy as np
import pytest
from physics_helpers import report
from test_episode_gradients import feedback, feedback_weights, make

from newton_qd.extractors import get_feet_contact_proportion
from newton_qd.gradients import GradientOptions, make_episode_gradient

pytestmark = [pytest.mark.slow, pytest.mark.optimized]
FEET = 4  # of an ant: rows of the Jacobian beside that of the fitness


@functools.cache
def memory(worlds: int, steps: int, every: int | None, rows: int = 1 + FEET) -> int:
    """Bytes that XLA allocates for a gradient of ants beside arguments and results.

    Args:
        worlds: Number of episodes.
        steps: Control steps of each.
        every: Control steps between the states that are kept.
        rows: Of the Jacobian: the fitness alone, or the descriptor too.
    """
    env = make("ant_uni", "float32")
    extractor: Any = None if rows == 1 else get_feet_contact_proportion
    run = make_episode_gradient(
        env,
        feedback,
        extractor,
        episode_length=steps,
        options=GradientOptions(checkpoint_every=every),
    )
    many = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct((worlds, *x.shape[1:]), x.dtype),
        feedback_weights(env, 1),
    )
    compiled = jax.jit(run).lower(many, jax.random.key(0)).compile()
    analysis = compiled.memory_analysis()
    assert analysis is not None
    return analysis.temp_size_in_bytes


def test_memory_is_a_state_per_control_step() -> None:
    """What docs/gradients.md states, of 1,000 steps."""
    short, long = (memory(1024, steps, 1) for steps in (100, 1000))
    slope = (long - short) / (900 * 1024)
    report("bytes per world and control step", slope)
    assert slope < 700
    report("GiB for 1,024 worlds", long / 2**30)
    assert long < 24 * 2**30
    many = memory(65536, 1000, 32)
    report("GiB for 65,536 worlds, a state every 32", many / 2**30)
    assert many < 64 * 2**30


def test_rows_of_the_jacobian_share_what_is_kept() -> None:
    """Five rows of 65,536 worlds: per control step little more than one row."""
    slopes, ends = {}, {}
    for rows in (1, 1 + FEET):
        short, long = (memory(65536, steps, 1, rows) for steps in (64, 128))
        slopes[rows] = (long - short) / (64 * 65536)
        ends[rows] = short / 65536 - 64 * slopes[rows]
    report("bytes per world and control step, by rows", slopes)
    report("bytes per world beside them, by rows", ends)
    row = (slopes[1 + FEET] - slopes[1]) / FEET
    report("bytes per row, world and control step", row)
    # not the state again: the adjoint of the readings, through the extractor's kernel
    assert row < 3 * FEET * np.dtype(np.float32).itemsize
