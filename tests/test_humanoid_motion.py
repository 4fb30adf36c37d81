"""The humanoid in motion: finite, standing as the original's, differentiable."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics_helpers import batched_step, random_states, report, variant

import newton_qd
from newton_qd.envs.base import State
from newton_qd.robots import HUMANOID


def test_joint_velocities_are_rates_of_the_angles(x64: None) -> None:
    """Also of the axes of one joint, however the others are bent."""
    system = variant(HUMANOID, "float64", substeps=1)
    q, v, control = random_states(system, np.random.default_rng(2), 8)
    after, rates, *_ = batched_step(system)(q, v, control)
    change = (np.asarray(after) - q)[:, 7:] / HUMANOID.dt
    np.testing.assert_allclose(change, np.asarray(rates)[:, 6:], rtol=1e-9, atol=1e-9)


@pytest.mark.slow
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
    state = jax.jit(robot.fixed_state)()
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
