"""Sums over the first episode of each world."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp

from newton_qd.checks import Fact, message
from newton_qd.envs.inputs import require_state
from newton_qd.envs.rollouts import RolloutOrder
from newton_qd.envs.state import State, at_fault
from newton_qd.types import Action, Metrics, Params, RNGKey
from newton_qd.wrappers.base import Wrapper


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class EvalMetrics:
    """Sums over the first episode.

    Attributes:
        episode_metrics: () sum of each metric, with the reward as a metric.
        active_episodes: () 1 during the first episode, then 0.
        episode_steps: () length of the episode so far.
    """

    episode_metrics: Metrics
    active_episodes: jax.Array
    episode_steps: jax.Array


class EvalWrapper(Wrapper):
    """Sums the metrics of the first episode after a reset.

    The sum of the rewards is ``-inf`` from a fault on, so that no fault pays.
    """

    STATE_INFO_KEY = "eval_metrics"

    rollout_order = RolloutOrder.IN_ORDER

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode with empty sums.

        Raises:
            ValueError: No ``EpisodeWrapper`` inside counts steps, or the environment is
                float64 and JAX x64 is off.
        """
        state = with_reward_metric(self.env.reset(rng))
        require_steps(state, type(self).__name__)
        sums = EvalMetrics(
            episode_metrics=jax.tree.map(jnp.zeros_like, state.metrics),
            active_episodes=jnp.ones_like(state.done),
            episode_steps=jnp.zeros_like(state.done),
        )
        return state.replace(info={**state.info, self.STATE_INFO_KEY: sums})

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances by one step and adds its metrics until the episode ends.

        Raises:
            TypeError: The state or the action has the wrong type.
            ValueError: The state has no sums of this wrapper, or the action has another
                shape.
        """
        require_state(state, self.STATE_INFO_KEY)
        sums = state.info[self.STATE_INFO_KEY]
        if not isinstance(sums, EvalMetrics):
            raise ValueError(f"Incorrect type for state_metrics: {type(sums)}")
        state = with_reward_metric(self.env.step(state, action, params))
        active = sums.active_episodes
        totals = jax.tree.map(
            functools.partial(_added, active), sums.episode_metrics, state.metrics
        )
        lost = at_fault(state) & (active > 0)
        totals = {**totals, "reward": jnp.where(lost, -jnp.inf, totals["reward"])}
        sums = EvalMetrics(
            episode_metrics=totals,
            active_episodes=active * (1 - state.done),
            episode_steps=jnp.where(
                active > 0, state.info["steps"], sums.episode_steps
            ),
        )
        return state.replace(info={**state.info, self.STATE_INFO_KEY: sums})


def _added(active: jax.Array, total: jax.Array, value: jax.Array) -> jax.Array:
    """Returns a sum with another value, if the episode is active."""
    # after the end, a metric may be anything, also nan; 0 times nan is nan
    counts = (active > 0) | jnp.isfinite(value)
    return total + jnp.where(counts, value, jnp.zeros_like(value)) * active


def with_reward_metric(state: State) -> State:
    """Returns the state with its reward among the metrics."""
    reward = jnp.copy(state.reward)  # its own buffer: the state can be donated
    return state.replace(metrics={**state.metrics, "reward": reward})


def require_steps(state: State, wrapper: str) -> None:
    """Raises an error if no ``EpisodeWrapper`` counts steps.

    Raises:
        ValueError: ``info`` has no steps.
    """
    if "steps" not in state.info:
        given = Fact("a state without info['steps']")
        allowed = (
            f"an environment with an EpisodeWrapper inside {wrapper} (episode_length "
            "given to create)"
        )
        raise ValueError(message("env", given, allowed))
