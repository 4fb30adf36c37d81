"""What the tests of the environments share: stacks, jitted functions, comparisons."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import newton_qd
from newton_qd.envs.base import Env
from newton_qd.envs.state import State
from newton_qd.physics.system import PhysicsState

# The tasks, and of those that differ by constants only, one: plain robots are the
# bases of their tasks, and these names repeat what other names do.
BOXES = {  # tests/test_mazes.py has these too
    *("antmaze_u", "antmaze_big", "antmaze_hardest"),
    *("humanoid_maze", "walker2d_trap"),
}
REPEATED = {"antnotrap", "humanoid_omni", "quadruped_omni", *BOXES}
NAMES = [
    name
    for name in newton_qd.registered_envs()
    if name in newton_qd.tables.descriptor_extractor and name not in REPEATED
]
# One with four feet, one with walls and one without physics; the others share their
# code with these and run with the slow tests.
_QUICK = {"ant_uni", "antmaze", "pointmaze"}


def named(name: str, *others: Any) -> Any:
    """A case of a task, slow where another one of its kind is not."""
    marks = () if name in _QUICK else pytest.mark.slow
    return pytest.param(name, *others, marks=marks)


EVERY_NAME = [named(name) for name in NAMES]
STACKS: dict[str, dict[str, Any]] = {
    "default": {},
    "bare": {"episode_length": None, "auto_reset": False},
    "repeat": {"action_repeat": 2},
    "fixed": {"fixed_init_state": True},
    "batch": {"batch_size": 3},
    "eval": {"batch_size": 3, "eval_metrics": True},
    "all": {
        "episode_length": 3,
        "action_repeat": 2,
        "batch_size": 3,
        "eval_metrics": True,
        "fixed_init_state": True,
    },
}


@functools.cache
def make(name: str, stack: str = "default") -> Env:
    return newton_qd.create(name, **STACKS[stack])


@functools.cache
def rollout(env: Env) -> Any:
    """Jitted function of one state and actions (t, nu): the states it went through."""

    def run(state: State, actions: jax.Array) -> State:
        def advance(state: State, action: jax.Array) -> tuple[State, State]:
            state = env.step(state, action)
            return state, state

        return jax.lax.scan(advance, state, actions)[1]

    return jax.jit(jax.vmap(run))


@functools.cache
def reset(env: Env) -> Any:
    return jax.jit(env.reset)


@functools.cache
def step(env: Env) -> Any:
    return jax.jit(env.step)


@functools.cache
def batched_reset(env: Env) -> Any:
    return jax.jit(jax.vmap(env.reset))


def keys(count: int, seed: int = 0) -> jax.Array:
    return jax.random.split(jax.random.key(seed), count)


def random_actions(env: Env, shape: tuple[int, ...], seed: int = 0) -> jax.Array:
    shape = (*shape, env.action_size)
    return jax.random.uniform(jax.random.key(seed), shape, env.dtype, -1.0, 1.0)


def worlds(env: Env, count: int) -> State:
    return batched_reset(env)(keys(count))


def zero_action(env: Env, state: State) -> jax.Array:
    return jnp.zeros((*state.done.shape, env.action_size), env.dtype)


def same(a: Any, b: Any) -> bool:
    """Whether two pytrees are equal bit by bit."""
    equal = jax.tree.map(
        lambda x, y: np.asarray(x).tobytes() == np.asarray(y).tobytes(), a, b
    )
    return all(jax.tree.leaves(equal))


def outline(tree: Any) -> Any:
    return [(x.shape, x.dtype, x.weak_type) for x in jax.tree.leaves(tree)]


def row(tree: Any, index: Any) -> Any:
    return jax.tree.map(lambda x: np.asarray(x)[index], tree)


def reshaped(tree: Any, old_axes: int, new: tuple[int, ...]) -> Any:
    return jax.tree.map(
        lambda x: np.asarray(x).reshape(*new, *x.shape[old_axes:]), tree
    )


def observation_layout(env: Env) -> tuple[tuple[str, int], ...]:
    layout: Any = getattr(env, "observation_layout")  # noqa: B009 - no Env has it
    return layout


def coordinates(state: State) -> jax.Array:
    """What a simulation starts from: of an environment without physics, its obs."""
    physics = state.pipeline_state
    return physics.q if isinstance(physics, PhysicsState) else state.obs


def with_coordinates(state: State, q: jax.Array) -> State:
    physics = state.pipeline_state
    if isinstance(physics, PhysicsState):
        return state.replace(pipeline_state=dataclasses.replace(physics, q=q))
    return state.replace(obs=q)


@functools.cache
def gradient(env: Env) -> Any:
    """Jitted gradient, to coordinates and actions, of a sum over what is returned."""

    def total(q: jax.Array, actions: jax.Array, state: State) -> jax.Array:
        states = rollout(env)(with_coordinates(state, q), actions)
        parts = (states.reward, states.obs, states.pipeline_state, states.metrics)
        zero = jnp.zeros((), env.dtype)
        return sum((jnp.sum(jnp.sin(x)) for x in jax.tree.leaves(parts)), zero)

    return jax.jit(jax.grad(total, argnums=(0, 1)))
