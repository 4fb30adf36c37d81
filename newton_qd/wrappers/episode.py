"""Episodes with a given length."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd import checks
from newton_qd.envs.base import Env
from newton_qd.envs.inputs import require_state
from newton_qd.envs.rollouts import RolloutOrder
from newton_qd.envs.state import State
from newton_qd.types import Action, Params, RNGKey
from newton_qd.wrappers.auto_reset import AutoResetWrapper
from newton_qd.wrappers.base import Wrapper, refuse_second


class EpisodeWrapper(Wrapper):
    """Counts steps, ends long episodes, and repeats actions.

    ``info["steps"]`` counts the control steps of the environment inside. The count
    stops when a world has a fault. ``info["truncation"]`` is 1 if the episode ended
    only because it reached its length.

    Attributes:
        episode_length: Control steps after which an episode ends.
        action_repeat: Control steps for each action.
    """

    rollout_order = RolloutOrder.IN_ORDER

    def __init__(self, env: Env, episode_length: int, action_repeat: int) -> None:
        """Wraps an environment.

        Args:
            env: The environment.
            episode_length: Control steps after which an episode ends.
            action_repeat: Control steps for each action.

        Raises:
            ValueError: A number is not an integer above 0, or ``env`` has an
                ``EpisodeWrapper`` already, or an ``AutoResetWrapper``.
        """
        why = "and both would count in info['steps']; see create(episode_length=None)"
        refuse_second(env, EpisodeWrapper, why)
        why = "which would not reset worlds at this length; put it around this wrapper"
        refuse_second(env, AutoResetWrapper, why)
        checks.integer("episode_length", episode_length)
        checks.integer("action_repeat", action_repeat)
        super().__init__(env)
        self.episode_length = int(episode_length)
        self.action_repeat = int(action_repeat)
        if self.action_repeat > 1:
            self.rollout_order = RolloutOrder.ONE_BY_ONE

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode at step 0.

        Raises:
            ValueError: The environment is float64 and JAX x64 is off.
        """
        state = self.env.reset(rng)
        counts = {
            "steps": jnp.zeros_like(state.done),
            "truncation": jnp.zeros_like(state.done),
        }
        return state.replace(info={**state.info, **counts})

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Repeats the action and sums rewards; all else is from the last repetition.

        Raises:
            TypeError: The state or the action has the wrong type.
            ValueError: The state comes from another environment, or the action has the
                wrong shape.
        """
        require_state(state, "steps")
        nstate, steps = state, state.info["steps"]
        if self.action_repeat == 1:
            nstate = self.env.step(state, action, params)
            steps = steps + _moving(state)
        else:
            nstate, steps = self._repeat(state, action, params)
        over = steps >= self.episode_length
        one = jnp.ones_like(nstate.done)
        info = {
            **nstate.info,
            "steps": steps,
            "truncation": jnp.where(over, one - nstate.done, jnp.zeros_like(one)),
        }
        return nstate.replace(done=jnp.where(over, one, nstate.done), info=info)

    def _repeat(
        self, state: State, action: Action, params: Params
    ) -> tuple[State, jax.Array]:
        def once(
            carry: tuple[State, jax.Array, jax.Array], _: None
        ) -> tuple[tuple[State, jax.Array, jax.Array], None]:
            state, steps, reward = carry
            nstate = self.env.step(state, action, params)
            carry = (nstate, steps + _moving(state), reward + nstate.reward)
            return carry, None

        start = (state, state.info["steps"], jnp.zeros_like(state.reward))
        last, _ = jax.lax.scan(once, start, None, length=self.action_repeat)
        nstate, steps, reward = last
        return nstate.replace(reward=reward), steps

    @property
    def dt(self) -> float:
        """Duration of a step with all repetitions [s]."""
        return self.env.dt * self.action_repeat


def _moving(state: State) -> jax.Array:
    """Returns 1 if the next step counts, because the world has no fault, else 0."""
    if "fault" not in state.info:
        return jnp.ones_like(state.done)
    return jnp.asarray(state.info["fault"] == 0, state.done.dtype)
