"""Worlds that reset themselves at the end of an episode."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd.checks import Fact, message
from newton_qd.envs.inputs import OWN_STATE, require_state
from newton_qd.envs.state import State, select
from newton_qd.types import READINGS, Action, Params, RNGKey
from newton_qd.wrappers.base import Wrapper


class AutoResetWrapper(Wrapper):
    """Returns a finished world to its first state.

    If a step is done, the simulation state, the observation and the state descriptor
    that it returns are those of the last call of ``reset``. Reward, done, truncation,
    metrics, steps and fault are those of the step. The next step counts from 0 and
    clears the fault.
    """

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode and stores its first state.

        Raises:
            ValueError: The environment is float64 and JAX x64 is off.
        """
        state = self.env.reset(rng)
        first = {
            "first_pipeline_state": state.pipeline_state,
            "first_obs": state.obs,
        }
        for key in READINGS:
            if key in state.info:
                first[f"first_{key}"] = state.info[key]
        # copies, so that no buffer is in a state twice: JAX can then donate the state
        first = jax.tree.map(jnp.copy, first)
        return state.replace(info={**state.info, **first})

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances by one step, then resets the finished worlds.

        Raises:
            TypeError: The state or the action has the wrong type.
            ValueError: The state comes from another environment, or the action has the
                wrong shape.
        """
        require_state(state, "first_obs")
        first, found = (jnp.shape(x) for x in (state.info["first_obs"], state.obs))
        size = self.observation_size
        if first != found or found[-1:] != (size,):
            given = Fact(f"first_obs and obs of shape {first} and {found}")
            allowed = f"{OWN_STATE}, so both of length {size}"
            raise ValueError(message("state", given, allowed))
        begins = state.done > 0
        counters = {key: state.info[key] for key in _COUNTERS if key in state.info}
        zeros = {key: jnp.zeros_like(value) for key, value in counters.items()}
        info = {**state.info, **select(begins, zeros, counters)}
        state = state.replace(done=jnp.zeros_like(state.done), info=info)
        state = self.env.step(state, action, params)
        current = {"pipeline_state": state.pipeline_state, "obs": state.obs}
        for key in READINGS:
            if f"first_{key}" in state.info:
                current[key] = state.info[key]
        first = {key: state.info[f"first_{key}"] for key in current}
        returned = select(state.done > 0, first, current)
        changes = {"pipeline_state": returned.pop("pipeline_state")}
        return state.replace(
            obs=returned.pop("obs"), info={**state.info, **returned}, **changes
        )


_COUNTERS = ("steps", "fault")
