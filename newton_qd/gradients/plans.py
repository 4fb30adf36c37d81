"""Episodes of a plan of actions, whose physics is one call."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from newton_qd.envs.env import Env
from newton_qd.envs.state import at_fault
from newton_qd.gradients.outcome import Tally
from newton_qd.physics.explicit_mesh import split_as
from newton_qd.types import Params


def run_plan(
    env: Env, first: Any, plan: jax.Array, params: Params, *, described: bool
) -> tuple[jax.Array, jax.Array | None, jax.Array, jax.Array]:
    """Runs a plan of actions in one world.

    Args:
        env: The environment.
        first: State of the world.
        plan: (T, nu) actions.
        params: Physical parameters of the world; ``None``: the default ones.
        described: Whether to return state descriptors.

    Returns:
        The sum () of rewards up to the first ``done``; the state descriptors (T, nd)
        before each step, or ``None``; whether the episode had ended before each step
        (T,); whether there was a fault () until then.
    """
    states = env.rollout(first, plan, params)
    ended = jax.lax.cummax((states.done > 0).astype(jnp.int32)) > 0
    none = split_as([states.done], jnp.zeros_like(ended[:1]))
    over = jnp.concatenate([none, ended[:-1]])
    bad = jnp.any(~over & jax.vmap(at_fault)(states))

    def add(tally: Tally, row: tuple[jax.Array, jax.Array]) -> tuple[Tally, None]:
        return tally.add(*row), None

    zero = split_as([states.reward], Tally.zero(states.reward.dtype))
    fitness = jax.lax.scan(add, zero, (states.reward, states.done))[0].fitness
    if not described:
        return fitness, None, over, bad
    begin, after = (x.info["state_descriptor"] for x in (first, states))
    begin = split_as([after], begin)
    return fitness, jnp.concatenate([begin[None], after[:-1]]), over, bad
