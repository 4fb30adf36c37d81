"""Sums over all completed episodes of each world."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from newton_qd.envs.inputs import require_state
from newton_qd.envs.rollouts import RolloutOrder
from newton_qd.envs.state import State, at_fault
from newton_qd.types import Action, Metrics, Params, RNGKey
from newton_qd.wrappers.auto_reset import AutoResetWrapper
from newton_qd.wrappers.base import Wrapper, outermost
from newton_qd.wrappers.evaluation import require_steps, with_reward_metric


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class CompletedEvalMetrics:
    """Sums over completed episodes, separate for each world.

    Attributes:
        current_episode_metrics: () sums over the running episode.
        completed_episodes_metrics: () sums over the completed episodes.
        completed_episodes: () number of completed episodes.
        completed_episodes_steps: () number of steps of all completed episodes.
        over: () 1 from the end of an episode until the world is reset, else 0.
    """

    current_episode_metrics: Metrics
    completed_episodes_metrics: Metrics
    completed_episodes: jax.Array
    completed_episodes_steps: jax.Array
    over: jax.Array


class CompletedEvalWrapper(Wrapper):
    """Sums the metrics of every episode that ends.

    The sum of the rewards is ``-inf`` from a fault on, so that no fault pays. Without
    auto-reset, steps after the end of an episode do not count. Each world has its own
    sums. For the totals of a batch, add them over the batch axis, which is the first
    axis of every leaf.
    """

    STATE_INFO_KEY = "completed_eval_metrics"

    rollout_order = RolloutOrder.IN_ORDER

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode with empty sums.

        Raises:
            ValueError: No ``EpisodeWrapper`` inside counts steps, or the environment is
                float64 and JAX x64 is off.
        """
        state = with_reward_metric(self.env.reset(rng))
        require_steps(state, type(self).__name__)
        sums = CompletedEvalMetrics(
            current_episode_metrics=jax.tree.map(jnp.zeros_like, state.metrics),
            completed_episodes_metrics=jax.tree.map(jnp.zeros_like, state.metrics),
            completed_episodes=jnp.zeros_like(state.done),
            completed_episodes_steps=jnp.zeros_like(state.done),
            over=jnp.zeros_like(state.done),
        )
        return state.replace(info={**state.info, self.STATE_INFO_KEY: sums})

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances by one step; adds an episode that ends to the completed ones.

        Raises:
            TypeError: The state or the action has the wrong type.
            ValueError: The state has no sums of this wrapper, or the action has another
                shape.
        """
        require_state(state, self.STATE_INFO_KEY)
        sums = state.info[self.STATE_INFO_KEY]
        if not isinstance(sums, CompletedEvalMetrics):
            raise ValueError(f"Incorrect type for state_metrics: {type(sums)}")
        # who resets worlds outside of this wrapper sets the steps to 0
        over = jnp.where(state.info["steps"] > 0, sums.over, jnp.zeros_like(sums.over))
        state = with_reward_metric(self.env.step(state, action, params))
        done = jnp.where(over > 0, jnp.zeros_like(over), state.done)
        resets = outermost(self.env, AutoResetWrapper) is not None
        current = jax.tree.map(jnp.add, sums.current_episode_metrics, state.metrics)
        reward = jnp.where(at_fault(state), -jnp.inf, current["reward"])
        current = {**current, "reward": reward}
        sums = CompletedEvalMetrics(
            current_episode_metrics=jax.tree.map(
                lambda x: jnp.where((done > 0) | (over > 0), jnp.zeros_like(x), x),
                current,
            ),
            completed_episodes_metrics=jax.tree.map(
                lambda total, value: jnp.where(done > 0, total + value, total),
                sums.completed_episodes_metrics,
                current,
            ),
            completed_episodes=sums.completed_episodes + done,
            completed_episodes_steps=(
                sums.completed_episodes_steps + state.info["steps"] * done
            ),
            over=jnp.zeros_like(over) if resets else jnp.maximum(over, done),
        )
        return state.replace(info={**state.info, self.STATE_INFO_KEY: sums})
