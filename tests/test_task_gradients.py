"""Gradients of every task, through its wrappers: those of fitness and descriptor."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics_helpers import (
    beside_a_wall,
    directional_errors,
    random_states,
    report,
)

import newton_qd
from newton_qd import physics
from newton_qd.envs.base import PhysicsEnv
from newton_qd.envs.state import State
from newton_qd.wrappers import FeetContactWrapper

WORLDS, STEPS = 50, 16
# The others are in tests/test_control_envs.py and tests/test_pointmaze.py.
LEGGED = ("ant", "halfcheetah", "hopper", "humanoid", "quadruped", "walker2d")
QUICK = ("ant_uni", "hopper_uni", "walker2d_uni", "humanoid_uni")
NAMES = [
    pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
    for name in newton_qd.registered_envs()
    if name.startswith(LEGGED) and name != "humanoidstandup"
]


def task(name: str) -> Any:
    """The task in double precision, its feet read smoothly."""
    env: Any = newton_qd.create(
        name, episode_length=None, auto_reset=False, dtype="float64"
    )
    if isinstance(env, FeetContactWrapper):
        return FeetContactWrapper(env.env, name.removesuffix("_uni"), smooth_width=0.02)
    return env


@pytest.mark.parametrize("name", NAMES)
def test_rewards_and_descriptors(x64: None, name: str) -> None:
    """Sum over 16 control steps, along q, v and actions, on 50 random states."""
    env = task(name)
    base = env.unwrapped
    assert isinstance(base, PhysicsEnv)
    system = base.system
    rng = np.random.default_rng(0)
    q, v, _ = random_states(system, rng, WORLDS)
    if system.scene is not None:
        q = beside_a_wall(system, q, rng)
    actions = rng.uniform(-1.0, 1.0, (WORLDS, STEPS * env.action_size))
    first = jax.jit(env.reset)(jax.random.key(0))
    weights = rng.normal(size=np.shape(first.info.get("state_descriptor", ())))

    def total(q: jax.Array, v: jax.Array, actions: jax.Array) -> jax.Array:
        def advance(state: State, action: jax.Array) -> tuple[State, jax.Array]:
            state = env.step(state, action)
            descriptor = state.info.get("state_descriptor", jnp.zeros(0))
            return state, state.reward + jnp.sum(weights * descriptor)

        state = first.replace(pipeline_state=physics.initial_state(system, q, v))
        return jax.lax.scan(advance, state, actions.reshape(STEPS, -1))[1].sum()

    # over 0.8 s of a halfcheetah the differences' own error, that of a square, is
    # 3e-4 at a distance of 1e-6
    errors = directional_errors(total, (q, v, actions), 1e-7)
    report("largest error for q, v, actions", errors.max(axis=1))
    assert np.isfinite(errors).all()
    assert errors.max() < 1e-4
