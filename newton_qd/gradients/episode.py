"""One episode of one world: its fitness and its descriptor."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from newton_qd.envs.state import select
from newton_qd.extractors import Trajectories
from newton_qd.gradients.flow import GradientOptions, passed_back

Policy = Callable[[Any, jax.Array], jax.Array]
"""Maps the parameters of a policy and an observation (no,) to an action (nu,)."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Outcome:
    """What an episode came to.

    Attributes:
        fitness: () sum of the rewards up to the first ``done``.
        descriptor: (D,) descriptor of the episode.
        faulty: () whether the world was at fault before the episode ended, or
            fitness or descriptor are not finite: they mean nothing then.
        transitions: Empty, or the fields of QDax's ``QDTransition`` by name,
            (T, ...) each.
    """

    fitness: jax.Array
    descriptor: jax.Array
    faulty: jax.Array
    transitions: dict[str, jax.Array] = dataclasses.field(default_factory=dict)


def make_episode(
    env: Any,
    policy: Policy | None,
    descriptor_extractor: Callable[[Any, jax.Array], jax.Array],
    *,
    episode_length: int,
    unravel: Callable[[Any], Any] = lambda genotype: genotype,
    options: GradientOptions | None = None,
    transitions: bool = False,
) -> Callable[[Any, jax.Array], Outcome]:
    """Builds the function that runs one episode.

    Args:
        env: Environment of one world with ``info["state_descriptor"]`` and without
            auto-reset.
        policy: Maps parameters and an observation to an action; ``None``: the
            parameters are the actions themselves, (episode_length, nu) or as many
            numbers in another shape.
        descriptor_extractor: Maps ``(data, mask)`` to descriptors (1, D), with
            ``data.state_desc`` (1, T, nd) and ``mask`` (1, T) equal to 1 after the
            end of the episode; ``newton_qd.descriptor_extractor`` has those of tasks.
        episode_length: Control steps.
        unravel: Maps a genotype to the parameters, once an episode.
        options: What becomes of the gradient on its way back; ``None``: no care is
            taken of its memory, and it is exact.
        transitions: Whether to return the steps, for algorithms that learn from
            them. An episode that ends early is followed by another one then, which
            counts for nothing else.

    Returns:
        Function of the genotype and the key of the reset. Under ``jax.vmap`` the
        worlds share the launches, and so do the rows of a Jacobian.
    """
    kept = options or GradientOptions(checkpoint_every=None)

    def run(genotype: Any, key: jax.Array) -> Outcome:
        parameters = unravel(genotype)
        first = state = env.reset(key)
        dtype = state.reward.dtype
        rows: dict[str, Any] = {}
        if not kept.exact:
            rows["factor"] = kept.factors(episode_length).astype(dtype)
        if policy is None:
            rows["action"] = parameters.reshape(episode_length, env.action_size)

        def advance(carry: tuple, row: dict[str, jax.Array]) -> tuple[tuple, tuple]:
            state, fitness, over, bad = carry
            begin = state
            if "factor" in row:
                state = passed_back(state, row["factor"], kept.clip)
            action = row["action"] if policy is None else policy(parameters, state.obs)
            state = env.step(state, action)
            steps = _transition(begin, action, state) if transitions else {}
            # The sum runs in time order here, not in a reduction over time, so
            # that a row's return does not depend on the size of the batch.
            fitness = jnp.where(over, fitness, fitness + state.reward)
            bad = bad | (~over & _at_fault(state))
            reading, ended = begin.info["state_descriptor"], state.done > 0
            if transitions:
                state = select(ended, first, state)
            return (state, fitness, over | ended, bad), (reading, over, steps)

        no = jnp.zeros((), bool)
        start = (state, jnp.zeros((), dtype), no, no)
        (_, fitness, _, bad), (readings, over, steps) = _scan(
            advance, start, rows, episode_length, kept.checkpoint_every
        )
        data = Trajectories(state_desc=readings[None])
        descriptor = descriptor_extractor(data, over[None].astype(readings.dtype))[0]
        bad = bad | ~jnp.isfinite(fitness) | ~jnp.all(jnp.isfinite(descriptor))
        return Outcome(fitness, descriptor, bad, steps)

    return run


def _scan(
    body: Callable[[Any, Any], tuple[Any, Any]],
    carry: Any,
    rows: Any,
    steps: int,
    every: int | None,
) -> tuple[Any, Any]:
    """``jax.lax.scan`` that keeps a carry every so many steps for its gradient."""
    if every is None:
        return jax.lax.scan(body, carry, rows, length=steps)
    if every == 1:
        body = jax.checkpoint(body, prevent_cse=False)
        return jax.lax.scan(body, carry, rows, length=steps)
    every = min(every, steps)
    segments = steps // every
    cut = segments * every

    def segment(carry: Any, rows: Any, length: int = every) -> tuple[Any, Any]:
        return jax.lax.scan(body, carry, rows, length=length)

    heads = jax.tree.map(lambda x: x[:cut].reshape(segments, every, *x.shape[1:]), rows)
    kept = jax.checkpoint(segment, prevent_cse=False)
    carry, readings = jax.lax.scan(kept, carry, heads, length=segments)
    readings = jax.tree.map(lambda x: x.reshape(cut, *x.shape[2:]), readings)
    if cut == steps:
        return carry, readings
    tail = jax.tree.map(lambda x: x[cut:], rows)
    kept = jax.checkpoint(functools.partial(segment, length=steps - cut))
    carry, last = kept(carry, tail)
    return carry, jax.tree.map(lambda *x: jnp.concatenate(x), readings, last)


def _transition(begin: Any, action: jax.Array, end: Any) -> dict[str, jax.Array]:
    """The fields of QDax's ``QDTransition`` for one step."""
    return {
        "obs": begin.obs,
        "next_obs": end.obs,
        "rewards": end.reward,
        "dones": end.done,
        "truncations": end.info["truncation"],
        "actions": action,
        "state_desc": begin.info["state_descriptor"],
        "next_state_desc": end.info["state_descriptor"],
    }


def _at_fault(state: Any) -> jax.Array:
    """Whether the physics contained a value that is not finite."""
    if "fault" in state.info:
        return state.info["fault"] != 0
    return jnp.zeros((), bool)
