"""Policies with their own weights per individual, and the return they earn."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from newton_qd.envs.state import select
from newton_qd.qd.extras import require_extra
from newton_qd.qd.task import Task

ScoringFunction = Callable[
    [jax.Array, jax.Array], tuple[jax.Array, jax.Array, dict[str, Any]]
]


@dataclasses.dataclass(frozen=True)
class Policy:
    """A multilayer perceptron whose weights are one vector.

    Attributes:
        size: Number of weights.
        init: Maps a key to weights (size,).
        unravel: Maps weights (size,) to the parameters that ``apply`` takes.
        apply: Maps parameters and an observation (O,) to an action (A,) inside
            [-1, 1].
        ravel: Maps parameters to weights (size,); undoes ``unravel``.
        network: The Flax module that ``apply`` calls.
    """

    size: int
    init: Callable[[jax.Array], jax.Array]
    unravel: Callable[[jax.Array], Any]
    apply: Callable[[Any, jax.Array], jax.Array]
    ravel: Callable[[Any], jax.Array]
    network: Any


@dataclasses.dataclass(frozen=True)
class Trajectories:
    """The part of the transitions that descriptor extractors read.

    Attributes:
        state_desc: (N, T, D) state descriptors before each step.
    """

    state_desc: jax.Array


def make_policy(env: Any, hidden: tuple[int, ...]) -> Policy:
    """Builds QDax's perceptron for an environment.

    Args:
        env: Environment with ``observation_size`` and ``action_size``.
        hidden: Widths of the hidden layers.

    Raises:
        MissingExtra: QDax is not installed.
    """
    require_extra("qdax", "qd")
    from qdax.core.neuroevolution.networks.networks import MLP

    network = MLP(
        layer_sizes=(*hidden, env.action_size),
        kernel_init=jax.nn.initializers.lecun_uniform(),
        final_activation=jnp.tanh,
    )
    dummy = jnp.zeros((env.observation_size,), jnp.float32)
    example = jax.eval_shape(network.init, jax.random.key(0), dummy)
    zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), example)
    flat, unravel = ravel_pytree(zeros)

    def init(key: jax.Array) -> jax.Array:
        return ravel_pytree(network.init(key, dummy))[0]

    def apply(parameters: Any, observation: jax.Array) -> jax.Array:
        return jnp.asarray(network.apply(parameters, observation))

    return Policy(
        size=flat.size,
        init=init,
        unravel=unravel,
        apply=apply,
        ravel=lambda parameters: ravel_pytree(parameters)[0],
        network=network,
    )


def make_scoring_function(
    task: Task, policy: Policy, episode_length: int, *, transitions: bool = False
) -> ScoringFunction:
    """Builds the function that evaluates a batch of individuals.

    All individuals start from the same reset state, so that the return of an
    individual depends on nothing but its weights.

    Args:
        task: Environment and descriptor.
        policy: Policy whose weights are the genotypes.
        episode_length: Control steps of an evaluation.
        transitions: Whether to return the steps, for algorithms that learn from
            them. An individual whose episode ends early begins another one then,
            which counts for nothing else.

    Returns:
        Function of genotypes (N, size) and a key for the reset; returns fitnesses
        (N,), descriptors (N, D) and a dict, which is empty or holds ``transitions``:
        the fields of QDax's ``QDTransition`` by name, (N, T, ...) each. An individual
        whose world was faulty or whose result is not finite has fitness ``-inf``:
        archives do not take it.
    """
    step = jax.vmap(task.env.step)
    act = jax.vmap(policy.apply)

    def score(
        genotypes: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, Any]]:
        count = genotypes.shape[0]
        parameters = jax.vmap(policy.unravel)(genotypes)
        state = jax.vmap(task.env.reset, in_axes=None, axis_size=count)(key)

        def advance(carry: tuple, _: None) -> tuple[tuple, tuple]:
            state, fitness, over, bad = carry
            begin, actions = state, act(parameters, state.obs)
            state = step(state, actions)
            steps = _transition(begin, actions, state) if transitions else {}
            # The sum runs in time order here, not in a reduction over time, so
            # that a row's return does not depend on the size of the batch.
            fitness = jnp.where(over, fitness, fitness + state.reward)
            bad = bad | (~over & _faulty(state))
            descriptor = begin.info["state_descriptor"]
            ended = state.done > 0
            if transitions:
                state = select(ended, first, state)
            return (state, fitness, over | ended, bad), (descriptor, over, steps)

        first = state
        start = (
            state,
            jnp.zeros_like(state.reward),
            jnp.zeros((count,), bool),
            jnp.zeros((count,), bool),
        )
        (_, fitness, _, bad), (descriptors, over, steps) = jax.lax.scan(
            advance, start, None, length=episode_length
        )
        data = Trajectories(state_desc=jnp.swapaxes(descriptors, 0, 1))
        mask = jnp.swapaxes(over, 0, 1).astype(descriptors.dtype)
        result = task.descriptor_extractor(data, mask)
        bad = bad | ~jnp.isfinite(fitness) | ~jnp.all(jnp.isfinite(result), axis=-1)
        extra = {}
        if transitions:
            extra = {
                "transitions": jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), steps)
            }
        return jnp.where(bad, -jnp.inf, fitness), result, extra

    return score


def _transition(begin: Any, actions: jax.Array, end: Any) -> dict[str, jax.Array]:
    """The fields of QDax's ``QDTransition`` for one step of every individual."""
    return {
        "obs": begin.obs,
        "next_obs": end.obs,
        "rewards": end.reward,
        "dones": end.done,
        "truncations": end.info["truncation"],
        "actions": actions,
        "state_desc": begin.info["state_descriptor"],
        "next_state_desc": end.info["state_descriptor"],
    }


def _faulty(state: Any) -> jax.Array:
    """(N,) whether the physics contained a non-finite value in this step."""
    if "fault" in state.info:
        return state.info["fault"] != 0
    return jnp.zeros(state.reward.shape, bool)
