"""The problems of ``optimize.py``: what is optimized, and how a solution is judged."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import newton_qd
from newton_qd.gradients import Episode
from newton_qd.types import Action, Params
from newton_qd.wrappers import Wrapper

STEPS = 250  # control steps of every episode
EVALUATIONS = 32  # resets that a policy is judged by
_EVALUATION_KEY = 2**31 - 1  # no seed of a run

Layers = list[tuple[jax.Array, jax.Array]]


def make_network(key: jax.Array, sizes: tuple[int, ...], last: float) -> Layers:
    """Weights of a perceptron.

    Args:
        key: Key of the random weights.
        sizes: Widths of its layers, input and output included.
        last: Scale of the weights of the last layer.
    """
    layers = []
    for index, (rows, columns) in enumerate(itertools.pairwise(sizes)):
        scale = (last if index == len(sizes) - 2 else 1.0) / np.sqrt(rows)
        own = jax.random.fold_in(key, index)
        weights = scale * jax.random.normal(own, (rows, columns), jnp.float32)
        layers.append((weights, jnp.zeros((columns,), jnp.float32)))
    return layers


def network(layers: Layers, x: jax.Array) -> jax.Array:
    """A perceptron with tanh between its layers and nothing after the last one."""
    for weights, bias in layers[:-1]:
        x = jnp.tanh(x @ weights + bias)
    weights, bias = layers[-1]
    return x @ weights + bias


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """A return to maximize.

    Attributes:
        name: Name in ``PROBLEMS``.
        env: Environment of one world, without auto-reset.
        policy: Maps a solution and an observation to an action; ``None``: the
            solutions are plans.
        scale: Mean and deviation of an observation under random actions, (no,) each.
    """

    name: str
    env: Any
    policy: Callable[[Any, jax.Array], jax.Array] | None
    scale: tuple[jax.Array, jax.Array]

    def seen(self, obs: jax.Array) -> jax.Array:
        """An observation (no,) as the networks see it."""
        mean, deviation = self.scale
        return (obs - mean) / deviation

    def returns(self, solutions: Any, keys: jax.Array) -> jax.Array:
        """Returns (n, resets) of n solutions from all of the resets."""
        episode = Episode(
            self.env,
            self.policy,
            episode_length=STEPS,
            unravel=jnp.tanh if self.policy is None else lambda x: x,
        )
        several = jax.vmap(jax.vmap(episode, (None, 0)), (0, None))
        outcome = several(solutions, keys)
        return jnp.where(outcome.faulty, 0, outcome.fitness)

    def keys(self, seed: int) -> jax.Array:
        """Resets that solutions of a run are judged by: a plan's own, or new ones."""
        if self.policy is None:
            return jax.random.key(seed)[None]
        return jax.random.split(jax.random.key(_EVALUATION_KEY), EVALUATIONS)

    @functools.cached_property
    def evaluate(self) -> Callable[[Any, jax.Array], jax.Array]:
        """Jitted return () of the best of several solutions, mean over resets."""
        return jax.jit(lambda s, keys: self.returns(s, keys).mean(axis=1).max())


def _scale(env: Any) -> tuple[jax.Array, jax.Array]:
    """Mean and deviation of observations over 100 random steps of 32 worlds."""
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 32))
    shape = (100, 32, env.action_size)
    actions = jax.random.uniform(jax.random.key(1), shape, env.dtype, -1, 1)

    def advance(state: Any, action: jax.Array) -> tuple[Any, jax.Array]:
        state = jax.vmap(env.step)(state, action)
        return state, state.obs

    obs = jax.lax.scan(advance, state, actions)[1].reshape(-1, env.observation_size)
    return obs.mean(axis=0), obs.std(axis=0) + 0.01


def _policy_problem(name: str, **options: Any) -> Problem:
    env = newton_qd.create(name, episode_length=None, auto_reset=False, **options)
    scale = jax.jit(functools.partial(_scale, env))()

    def policy(layers: Layers, obs: jax.Array) -> jax.Array:
        return jnp.tanh(network(layers, (obs - scale[0]) / scale[1]))

    return Problem(name, env, policy, scale)


def _plan_problem(name: str) -> Problem:
    env = newton_qd.create(name, episode_length=None, auto_reset=False)
    none = jnp.zeros((env.observation_size,), jnp.float32)
    return Problem(name, env, None, (none, none + 1))


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "hopper": functools.partial(_plan_problem, "hopper"),
    "ant": functools.partial(_policy_problem, "ant", use_contact_forces=False),
    "halfcheetah": functools.partial(_policy_problem, "halfcheetah"),
}


class Cautious(Wrapper):
    """A hopper whose reward falls before it does.

    The end of an episode is a jump, which no gradient sees: a penalty on lean and
    height that begins inside of the healthy range is what it sees instead.
    """

    def __init__(self, env: Any, weight: float) -> None:
        """Wraps a hopper.

        Args:
            env: The hopper.
            weight: Reward of a step that is lost at the edge of the healthy range [-].
        """
        super().__init__(env)
        self._weight = weight

    def step(self, state: Any, action: Action, params: Params = None) -> Any:
        """Advances by one step."""
        state = self.env.step(state, action, params)
        height, pitch = state.pipeline_state.q[1], state.pipeline_state.q[2]
        # healthy: |pitch| below 0.2 rad, height above 0.7 m; it stands at 1.25 m
        lean = jnp.maximum(jnp.abs(pitch) / 0.2 - 0.25, 0) / 0.75
        low = jnp.maximum(1.0 - height, 0) / 0.3
        penalty = self._weight * (jnp.square(lean) + jnp.square(low))
        return state.replace(reward=state.reward - penalty)
