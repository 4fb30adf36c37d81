"""Rewards with a constant added."""

from __future__ import annotations

from newton_qd import checks
from newton_qd.envs.base import Env
from newton_qd.envs.rollouts import RolloutOrder
from newton_qd.envs.state import State
from newton_qd.types import Action, Params, RNGKey
from newton_qd.wrappers.base import Wrapper


class OffsetRewardWrapper(Wrapper):
    """Adds a constant to the reward of resets and steps."""

    rollout_order = RolloutOrder.AT_ONCE

    def __init__(self, env: Env, offset: float = 0.0) -> None:
        """Wraps an environment.

        Args:
            env: The environment; the offset is added once for a repeated action.
            offset: Number to add, such as ``newton_qd.tables.reward_offset[name]``.

        Raises:
            TypeError: ``offset`` is not a number.
            ValueError: ``offset`` is not finite.
        """
        checks.number("offset", offset)
        super().__init__(env)
        self._offset = float(offset)

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode.

        Raises:
            ValueError: The environment is float64 and JAX x64 is off.
        """
        return self._shifted(self.env.reset(rng))

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances by one step.

        Raises:
            TypeError: The state or the action has the wrong type.
            ValueError: The state comes from another environment, or the action has the
                wrong shape.
        """
        return self._shifted(self.env.step(state, action, params))

    def _shifted(self, state: State) -> State:
        return state.replace(reward=state.reward + self._offset)
