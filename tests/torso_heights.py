"""Robots whose torso is put at a height."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from newton_qd.envs.state import State


@functools.cache
def raised(env: Any) -> Callable[[float], State]:
    """The state one step after the torso is put at a height."""

    def after(height: jax.Array) -> State:
        state = env.fixed_state()
        start = state.pipeline_state
        high = dataclasses.replace(start, q=start.q.at[2].set(height))
        state = state.replace(pipeline_state=high)
        return env.step(state, np.zeros(env.action_size, np.float32))

    return jax.jit(after)
