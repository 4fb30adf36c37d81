"""The humanoid in motion: finite, standing as the original's, differentiable."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics_helpers import batched_step, random_states, report, variant

import newton_qd
from newton_qd import physics
from newton_qd.envs.base import State
from newton_qd.envs.humanoid import Humanoid
from newton_qd.robots import HUMANOID


def test_joint_velocities_are_rates_of_the_angles(x64: None) -> None:
    """Also of the axes of one joint, however the others are bent."""
    system = variant(HUMANOID, "float64", substeps=1)
    q, v, control = random_states(system, np.random.default_rng(2), 8)
    after, rates, *_ = batched_step(system)(q, v, control)
    change = (np.asarray(after) - q)[:, 7:] / HUMANOID.dt
    np.testing.assert_allclose(change, np.asarray(rates)[:, 6:], rtol=1e-9, atol=1e-9)


def test_random_actions_stay_finite() -> None:
    steps, worlds = 2000, 16
    env = newton_qd.create("humanoid_uni", episode_length=None, auto_reset=False)
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), worlds))

    def advance(state: State, key: jax.Array) -> tuple[State, jax.Array]:
        shape = (worlds, env.action_size)
        action = jax.random.uniform(key, shape, np.float32, -1.0, 1.0)
        state = jax.vmap(env.step)(state, action)
        return state, jnp.stack([state.reward, jnp.abs(state.obs).max(axis=1)])

    keys = jax.random.split(jax.random.key(1), steps)
    end, seen = jax.jit(lambda s, k: jax.lax.scan(advance, s, k))(state, keys)
    newton_qd.check(end)
    assert np.all(np.isfinite(seen))
    report("largest observation", np.asarray(seen)[:, 1].max())


def test_it_stands_on_its_feet_and_falls_as_the_original() -> None:
    env: Any = newton_qd.create("humanoid_uni", episode_length=None, auto_reset=False)
    robot = env.unwrapped
    zero = jnp.zeros((100, env.action_size), np.float32)
    state = robot.fixed_state()
    contact = jnp.zeros(2, np.float32)
    state = state.replace(info={**state.info, "state_descriptor": contact})
    states = jax.jit(
        lambda s: jax.lax.scan(lambda s, u: (env.step(s, u),) * 2, s, zero)[1]
    )(state)
    touching = np.asarray(states.info["state_descriptor"])
    report("contact fraction", touching.mean(axis=0))
    report("first done, sum of rewards", (np.argmax(states.done), states.reward.sum()))
    # the original: contact 0.93, done after 58 steps, 558.6
    assert np.all(touching.mean(axis=0) > 0.85)
    assert 50 < np.argmax(states.done) + 1 < 66
    assert float(states.reward.sum()) == pytest.approx(558.6, rel=0.02)


GRADIENT_STEPS, GRADIENT_STATES = 16, 50


def test_gradient_of_a_reward_sum(x64: None) -> None:
    env = Humanoid(dtype="float64")
    system, rng = env.system, np.random.default_rng(0)
    q, v, _ = random_states(system, rng, GRADIENT_STATES)
    actions = rng.uniform(-1, 1, (GRADIENT_STATES, GRADIENT_STEPS, env.action_size))
    fixed = env.fixed_state()

    def total(q: jax.Array, v: jax.Array, actions: jax.Array) -> jax.Array:
        start = physics.initial_state(system, q, v)

        def advance(state: State, action: jax.Array) -> tuple[State, jax.Array]:
            state = env.step(state, action)
            return state, state.reward

        state = fixed.replace(pipeline_state=start)
        return jax.lax.scan(advance, state, actions)[1].sum()

    value = jax.jit(jax.vmap(total))
    inputs = (q, v, actions)
    gradients = jax.jit(jax.vmap(jax.grad(total, argnums=(0, 1, 2))))(*inputs)
    errors = []
    for i, gradient in enumerate(map(np.asarray, gradients)):
        assert np.all(np.isfinite(gradient))
        assert np.all(np.abs(gradient).reshape(GRADIENT_STATES, -1).max(axis=1) > 0)
        direction = rng.normal(size=inputs[i].shape)
        ahead, behind = (
            value(*inputs[:i], inputs[i] + h * direction, *inputs[i + 1 :])
            for h in (1e-6, -1e-6)
        )
        difference = np.asarray(ahead - behind) / 2e-6
        axes = tuple(range(1, gradient.ndim))
        exact = (gradient * direction).sum(axis=axes)
        size = np.sqrt((gradient**2).sum(axis=axes) * (direction**2).sum(axis=axes))
        errors.append(np.max(np.abs(difference - exact) / size))
    report("largest error for q, v, actions", errors)
    assert max(errors) < 1e-4
