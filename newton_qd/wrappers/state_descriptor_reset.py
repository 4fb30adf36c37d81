"""State descriptors that are reset with the world."""

from __future__ import annotations

import jax.numpy as jnp

from newton_qd.envs.state import State, select
from newton_qd.types import Action, Params, RNGKey
from newton_qd.wrappers.qd import QDWrapper


class StateDescriptorResetWrapper(QDWrapper):
    """Resets the state descriptor of a finished world to its first value.

    ``AutoResetWrapper`` does this already. Use this wrapper if another wrapper resets
    the worlds. It does not change the observation.
    """

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode and stores its first state descriptor.

        Raises:
            KeyError: No wrapper inside writes a state descriptor.
            ValueError: The environment is float64 and JAX x64 is off.
        """
        state = self.env.reset(rng)
        if "state_descriptor" not in state.info:
            raise KeyError(
                "info['state_descriptor'] is missing: StateDescriptorResetWrapper "
                "needs a descriptor wrapper inside, such as FeetContactWrapper"
            )
        first = jnp.copy(state.info["state_descriptor"])
        return state.replace(info={**state.info, "first_state_descriptor": first})

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances by one step, then resets the state descriptors of finished worlds.

        Raises:
            TypeError: The state or the action has the wrong type.
            ValueError: The state comes from another environment, or the action has the
                wrong shape.
        """
        state = self.env.step(state, action, params)
        first = state.info["first_state_descriptor"]
        descriptor = select(state.done > 0, first, state.info["state_descriptor"])
        return state.replace(info={**state.info, "state_descriptor": descriptor})
