"""What the tests of the modules of QDax share: a task as QDax's examples make it."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp


class Setup(NamedTuple):
    """A task with small policies, as QDax's examples make it."""

    env: Any
    policy: Any
    score: Callable[..., Any]
    params: Any
    name: str
    episode_length: int


@functools.cache
def setup(name: str, batch: int = 16, episode_length: int = 24) -> Setup:
    creators: Any = importlib.import_module("newton_qd.compat.env_creators")
    env, policy, score = creators.create_default_brax_task_components(
        name, jax.random.key(0), episode_length, (8,)
    )
    keys = jax.random.split(jax.random.key(1), batch)
    params = jax.vmap(policy.init)(keys, jnp.zeros((batch, env.observation_size)))
    return Setup(env, policy, score, params, name, episode_length)
