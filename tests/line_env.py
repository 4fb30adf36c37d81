"""What the tests of wrappers share: a point on a line."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.envs.base import Env
from newton_qd.envs.state import State
from newton_qd.types import Params

KEY = jax.random.key(0)


class Line(Env):
    """A point on a line: it moves by the action and is done beyond ``end``.

    The reward is the new position; ``params`` is a speed.
    """

    def __init__(self, end: float = 100.0) -> None:
        self._end = end

    def reset(self, rng: jax.Array) -> State:
        position = jax.random.uniform(rng, (), np.float32, 0.0, 0.5)
        return State(
            pipeline_state=position,
            obs=position[None],
            reward=jnp.zeros((), np.float32),
            done=jnp.zeros((), np.float32),
            metrics={"moved": jnp.zeros((), np.float32)},
            info={
                "state_descriptor": position[None],
                "fault": jnp.zeros((), np.int32),
            },
        )

    def step(self, state: State, action: jax.Array, params: Params = None) -> State:
        move = action[0] if params is None else action[0] * params
        position = state.pipeline_state + move
        return state.replace(
            pipeline_state=position,
            obs=position[None],
            reward=position,
            done=(position > self._end).astype(np.float32),
            metrics={**state.metrics, "moved": move},
            info={**state.info, "state_descriptor": position[None]},
        )

    @property
    def observation_size(self) -> int:
        return 1

    @property
    def action_size(self) -> int:
        return 1

    @property
    def dtype(self) -> np.dtype:
        return np.dtype(np.float32)

    @property
    def dt(self) -> float:
        return 0.5

    @property
    def name(self) -> str:
        return "line"


def play(env: Env, steps: int, action: float = 1.0) -> list[State]:
    """The reset and the states after it."""
    states = [jax.jit(env.reset)(KEY)]
    step = jax.jit(env.step)
    for _ in range(steps):
        shape = (*states[-1].done.shape, 1)
        states.append(step(states[-1], jnp.full(shape, action, np.float32)))
    return states


def column(states: list[State], key: str) -> list[float]:
    return [float(state.info[key]) for state in states[1:]]
