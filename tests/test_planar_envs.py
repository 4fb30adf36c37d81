"""Halfcheetah, hopper and walker2d: observation, reward and end, reckoned in NumPy."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from newton_qd.envs import HalfCheetah, Hopper, PhysicsEnv, Walker2d
from newton_qd.envs.base import State
from newton_qd.envs.planar import euler_pitch
from newton_qd.physics import reference

WORLDS, STEPS = 16, 10


class Task(NamedTuple):
    """What the original says about a robot.

    ``low``, ``high`` and ``lean`` are the healthy heights and the healthy pitch on
    either side, ``noise`` that of a reset, ``rest`` the first observation's start.
    """

    env: Callable[..., PhysicsEnv]
    size: int
    weights: tuple[float, float, float]  # of velocity, of squared actions, bonus
    low: float
    high: float
    lean: float
    noise: float
    rest: tuple[float, ...]


UPRIGHT = (1.0, 1e-3, 1.0)
CHEETAH_REST = (0.583585, 1, 0, 0.265, 0, 0.1925, -0.15, -0.165, 0)
TASKS = {
    "halfcheetah": Task(
        HalfCheetah, 18, (1.0, 0.1, 0.0), -np.inf, np.inf, np.inf, 0.1, CHEETAH_REST
    ),
    "hopper": Task(Hopper, 11, UPRIGHT, 0.7, np.inf, 0.2, 5e-3, (1.25,)),
    "walker2d": Task(Walker2d, 17, UPRIGHT, 0.7, 2.0, 1.0, 5e-3, (1.19,)),
}
FALLING = ("hopper", "walker2d")


@functools.cache
def make(name: str, **options: Any) -> Any:
    return TASKS[name].env(**options)


@functools.cache
def rolled(name: str, **options: Any) -> tuple[State, State, np.ndarray]:
    """States before and after each step of random worlds, and the actions."""
    env, rng = make(name, **options), np.random.default_rng(0)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), WORLDS))
    q = np.array(state.pipeline_state.q)
    q[:, 0] = rng.normal(size=WORLDS)
    q[:, 1] += rng.uniform(-0.6, 1.0, WORLDS)
    q[:, 2] = rng.uniform(-4.0, 4.0, WORLDS) * (rng.random(WORLDS) > 0.4)
    v = rng.normal(size=(WORLDS, env.system.nv)).astype(np.float32)
    thrown = dataclasses.replace(state.pipeline_state, q=q, v=jnp.asarray(v))
    shape = (STEPS, WORLDS, env.action_size)
    actions = rng.uniform(-1.5, 1.5, shape).astype(np.float32)

    def advance(state: State, action: jax.Array) -> tuple[State, tuple[State, State]]:
        after = jax.vmap(env.step)(state, action)
        return after, (state, after)

    states: Any = jax.jit(lambda s, a: jax.lax.scan(advance, s, a)[1])(
        state.replace(pipeline_state=thrown), actions
    )
    before, after = jax.tree.map(np.asarray, states)
    return before, after, actions


def pitch_of(angle: np.ndarray) -> np.ndarray:
    """Euler angle about y, from the quaternion as the original reads it."""
    w, y = np.cos(angle.astype(np.float64) / 2), np.sin(angle.astype(np.float64) / 2)
    return np.arcsin(np.clip(2 * w * y, -1, 1))


@pytest.mark.parametrize("name", TASKS)
def test_observation(name: str) -> None:
    _, after, _ = rolled(name)
    q, v = after.pipeline_state.q, after.pipeline_state.v
    angle = q[..., 2:3]
    half = angle / 2
    turned = (
        [np.cos(half), np.sin(half)] if name == "halfcheetah" else [pitch_of(angle)]
    )
    expected = np.concatenate([q[..., 1:2], *turned, q[..., 3:], v], axis=-1)
    assert after.obs.shape[-1] == TASKS[name].size == make(name).observation_size
    np.testing.assert_allclose(after.obs, expected, rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize("name", TASKS)
def test_reward_done_and_metrics(name: str) -> None:
    before, after, actions = rolled(name)
    task, env = TASKS[name], make(name)
    start, end = before.pipeline_state.q, after.pipeline_state.q
    velocity = (end[..., 0] - start[..., 0]) / env.dt
    weight, cost, bonus = task.weights
    control = cost * np.sum(actions**2, axis=-1)
    pitch = pitch_of(end[..., 2])
    healthy = (end[..., 1] >= task.low) & (end[..., 1] <= task.high)
    healthy &= np.abs(pitch) <= task.lean
    np.testing.assert_array_equal(after.done, 1.0 - healthy)
    run = "reward_run" if name == "halfcheetah" else "reward_forward"
    expected = {
        run: weight * velocity,
        "reward_ctrl": -control,
        "x_position": end[..., 0],
        "x_velocity": velocity,
    }
    if name in FALLING:
        assert 0 < healthy.mean() < 1
        expected["reward_healthy"] = np.full_like(velocity, bonus)
    assert set(after.metrics) == set(expected)
    for key, value in expected.items():
        np.testing.assert_allclose(after.metrics[key], value, rtol=1e-5, atol=1e-5)
    reward = weight * velocity + bonus - control
    np.testing.assert_allclose(after.reward, reward, rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize("name", FALLING)
def test_unhealthy_without_an_end(name: str) -> None:
    """It loses its bonus; the states are those of the other environment."""
    _, ending, _ = rolled(name)
    _, after, _ = rolled(name, terminate_when_unhealthy=False, healthy_reward=2.0)
    assert not after.done.any()
    np.testing.assert_array_equal(
        after.metrics["reward_healthy"], 2.0 * (1.0 - ending.done)
    )
    difference = after.metrics["reward_healthy"] - 1.0
    np.testing.assert_allclose(after.reward - ending.reward, difference, atol=1e-4)


@pytest.mark.parametrize("name", FALLING)
def test_healthy_ranges(name: str) -> None:
    ranges = {"healthy_z_range": (0.9, 1.3), "healthy_angle_range": (-0.1, 0.5)}
    _, after, _ = rolled(name, **ranges)
    q = after.pipeline_state.q
    pitch = pitch_of(q[..., 2])
    healthy = (q[..., 1] >= 0.9) & (q[..., 1] <= 1.3) & (pitch >= -0.1) & (pitch <= 0.5)
    assert 0 < healthy.mean() < 1
    np.testing.assert_array_equal(after.done, 1.0 - healthy)


@pytest.mark.parametrize("name", TASKS)
def test_weights(name: str) -> None:
    _, plain, _ = rolled(name)
    _, after, _ = rolled(name, forward_reward_weight=3.0, ctrl_cost_weight=0.5)
    run = "reward_run" if name == "halfcheetah" else "reward_forward"
    np.testing.assert_allclose(after.metrics[run], 3 * plain.metrics[run], rtol=1e-6)
    ratio = 0.5 / TASKS[name].weights[1]
    np.testing.assert_allclose(
        after.metrics["reward_ctrl"], ratio * plain.metrics["reward_ctrl"], rtol=1e-5
    )


@pytest.mark.parametrize("name", TASKS)
def test_position_may_be_observed(name: str) -> None:
    _, plain, _ = rolled(name)
    env = {"exclude_current_positions_from_observation": False}
    _, after, _ = rolled(name, **env)
    np.testing.assert_array_equal(after.obs[..., 0], after.pipeline_state.q[..., 0])
    np.testing.assert_array_equal(after.obs[..., 1:], plain.obs)
    assert make(name, **env).observation_layout[0] == ("torso position x [m]", 1)


@pytest.mark.parametrize("name", TASKS)
def test_reset(name: str) -> None:
    """The default pose of the original, with noise on the joints alone."""
    task, env = TASKS[name], make(name)
    rest = np.zeros(task.size)
    rest[: len(task.rest)] = task.rest
    np.testing.assert_allclose(jax.jit(env.fixed_state)().obs, rest, atol=1e-6)
    keys = jax.random.split(jax.random.key(0), 64)
    state = jax.jit(jax.vmap(env.reset))(keys).pipeline_state
    q, v = np.asarray(state.q), np.asarray(state.v)
    assert not q[:, [0, 2]].any() and not v[:, :3].any()
    for noise in (q[:, 3:] - env.system.rest_q[3:], v[:, 3:]):
        assert np.abs(noise).max() <= task.noise * (1 + 1e-4)
        assert np.all(np.abs(noise).max(axis=0) > 0.8 * task.noise)
    if name == "halfcheetah":
        lowest = [reference.lowest_contact(env.system, row) for row in q]
        np.testing.assert_allclose(lowest, 0.0, atol=1e-6)
    else:
        np.testing.assert_allclose(q[:, 1], task.rest[0], atol=1e-6)
    wide = jax.jit(task.env(reset_noise_scale=0.0).reset)(jax.random.key(0))
    np.testing.assert_allclose(wide.obs, rest, atol=1e-6)


@pytest.mark.parametrize("name", TASKS)
def test_joint_velocities_are_rates_of_the_angles(name: str) -> None:
    env = make(name)
    still = jax.jit(env.fixed_state)()
    push = jnp.zeros(env.action_size, np.float32).at[0].set(-0.05)
    after = jax.jit(env.step)(still, push)
    angle = -2 * env.action_size - 3
    assert after.obs[angle] < still.obs[angle]
    assert after.obs[-env.action_size] < 0


@pytest.mark.parametrize("name", FALLING)
def test_velocities_do_not_grow(name: str) -> None:
    """In free flight; the original multiplied them by exp(dt)."""
    env = make(name)
    state = jax.jit(env.fixed_state)()
    start = state.pipeline_state
    q, v = start.q.at[1].add(1.0), start.v.at[0].set(1.0)
    flying = state.replace(pipeline_state=dataclasses.replace(start, q=q, v=v))
    after = jax.jit(env.step)(flying, jnp.zeros(env.action_size, np.float32))
    assert float(after.pipeline_state.v[0]) == pytest.approx(1.0, abs=1e-6)
    assert float(after.metrics["x_velocity"]) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("name", TASKS)
def test_unknown_option(name: str) -> None:
    with pytest.raises(TypeError, match="legacy_spring"):
        TASKS[name].env(legacy_spring=True)


def test_euler_pitch_has_a_gradient_everywhere() -> None:
    angle = np.concatenate([np.linspace(-12.0, 12.0, 997), [np.pi / 2, -np.pi / 2]])
    found = jax.jit(euler_pitch)(jnp.asarray(angle, np.float32))
    np.testing.assert_allclose(found, np.arcsin(np.sin(angle)), atol=3e-6)
    slope = jax.jit(jax.vmap(jax.grad(euler_pitch)))(jnp.asarray(angle, np.float32))
    assert set(np.unique(slope)) == {-1.0, 1.0}


def test_feet_of_a_world_at_fault_carry_what_they_carried_before() -> None:
    env = make("hopper")
    first, step = jax.jit(env.fixed_state)(), jax.jit(env.step)
    falling = dataclasses.replace(
        first.pipeline_state, v=first.pipeline_state.v.at[1].set(-2000.0)
    )
    for after in (
        step(first, jnp.full(3, jnp.nan, env.dtype)),
        step(first.replace(pipeline_state=falling), jnp.zeros(3, env.dtype)),
    ):
        assert after.info["fault"] == 1
        for name in ("feet_contact", "smooth_feet_contact"):
            seen = (getattr(s.pipeline_state, name) for s in (first, after))
            np.testing.assert_allclose(*seen, rtol=1e-5)
