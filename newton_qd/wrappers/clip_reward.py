"""Rewards within limits."""

from __future__ import annotations

import math

import jax.numpy as jnp

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.envs.base import Env
from newton_qd.envs.rollouts import RolloutOrder
from newton_qd.envs.state import State
from newton_qd.types import Action, Params, RNGKey
from newton_qd.wrappers.base import Wrapper


class ClipRewardWrapper(Wrapper):
    """Keeps the reward of resets and steps within limits."""

    rollout_order = RolloutOrder.AT_ONCE

    def __init__(
        self,
        env: Env,
        clip_min: float | None = None,
        clip_max: float | None = None,
    ) -> None:
        """Wraps an environment.

        Args:
            env: The environment.
            clip_min: Lowest reward; ``None``: no limit.
            clip_max: Highest reward, not below ``clip_min``; ``None``: no limit.

        Raises:
            ValueError: A limit is not a number, or ``clip_min`` is above ``clip_max``.
        """
        for name, value in (("clip_min", clip_min), ("clip_max", clip_max)):
            checks.number(name, value, endless=True, optional=True, error=ValueError)
        if clip_min is not None and clip_max is not None and clip_min > clip_max:
            allowed = "clip_min not above clip_max"
            raise ValueError(
                message("clip_min, clip_max", (clip_min, clip_max), allowed)
            )
        super().__init__(env)
        self._low = -math.inf if clip_min is None else float(clip_min)
        self._high = math.inf if clip_max is None else float(clip_max)

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode.

        Raises:
            ValueError: The environment is float64 and JAX x64 is off.
        """
        return self._clipped(self.env.reset(rng))

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances by one step.

        Raises:
            TypeError: The state or the action has the wrong type.
            ValueError: The state comes from another environment, or the action has the
                wrong shape.
        """
        return self._clipped(self.env.step(state, action, params))

    def _clipped(self, state: State) -> State:
        return state.replace(reward=jnp.clip(state.reward, self._low, self._high))
