"""The ant's observation, reward and end, reckoned again in NumPy."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from torso_heights import raised

from newton_qd import physics
from newton_qd.envs.ant import Ant
from newton_qd.envs.contacts import isotropic_inertia
from newton_qd.envs.state import State
from newton_qd.envs.vectors import length

ANT = Ant()
ANGLE = np.radians(50.0)
REST_ANGLES = [0, ANGLE, 0, -ANGLE, 0, -ANGLE, 0, ANGLE]


def roll(env: Ant, steps: int) -> tuple[State, State, np.ndarray]:
    """States before and after each step of 4 worlds, and the actions."""
    keys = jax.random.split(jax.random.key(0), 4)
    start = jax.jit(jax.vmap(env.reset))(keys)
    shape = (steps, 4, env.action_size)
    actions = jax.random.uniform(jax.random.key(1), shape, np.float32, -1.0, 1.0)

    def advance(state: State, action: jax.Array) -> tuple[State, tuple[State, State]]:
        after = jax.vmap(env.step)(state, action)
        return after, (state, after)

    states: Any = jax.jit(lambda s, a: jax.lax.scan(advance, s, a)[1])(start, actions)
    before, after = jax.tree.map(np.asarray, states)
    return before, after, np.asarray(actions)


@pytest.fixture(scope="module")
def rolled() -> tuple[State, State, np.ndarray]:
    return roll(ANT, 30)


def test_the_default_pose_is_the_one_of_the_original() -> None:
    observed = np.asarray(jax.jit(ANT.fixed_state)().obs)
    expected = np.zeros(87)
    expected[:13] = [0.51334, 1, 0, 0, 0, *REST_ANGLES]
    np.testing.assert_allclose(observed, expected, atol=2e-5)


def test_reset_noise_is_on_the_joints_alone() -> None:
    keys = jax.random.split(jax.random.key(0), 64)
    state = jax.jit(jax.vmap(ANT.reset))(keys).pipeline_state
    q, v = np.asarray(state.q), np.asarray(state.v)
    assert np.all(q[:, :2] == 0) and np.all(q[:, 3:7] == [0, 0, 0, 1])
    assert np.all(v[:, :6] == 0)
    for noise in (q[:, 7:] - REST_ANGLES, v[:, 6:]):
        assert np.all(np.abs(noise) <= 0.1 + 1e-6)
        assert np.all(np.abs(noise).max(axis=0) > 0.08)
        assert np.all(np.abs(noise.mean(axis=0)) < 0.03)
    lowest_of = jax.vmap(lambda q: physics.lowest_contact(ANT.system, q))
    lowest = jax.jit(lowest_of)(state.q)
    np.testing.assert_allclose(lowest, 0.0, atol=1e-6)


def test_observation(rolled: tuple[State, State, np.ndarray]) -> None:
    _, after, _ = rolled
    state, masses = after.pipeline_state, ANT.system.mass
    q, v = state.q, state.v
    linear = np.clip(state.impulse[..., :3] / masses[:, None], -1, 1)
    moments = ANT.system.inertia[:, 0, 0]
    angular = np.clip(state.impulse[..., 3:] / moments[:, None], -1, 1)
    ground = np.zeros((*q.shape[:-1], 3))
    expected = np.concatenate(
        [
            q[..., 2:3],
            q[..., 6:7],
            q[..., 3:6],
            q[..., 7:],
            v,
            linear.reshape(*q.shape[:-1], 27),
            ground,
            angular.reshape(*q.shape[:-1], 27),
            ground,
        ],
        axis=-1,
    )
    np.testing.assert_allclose(after.obs, expected, rtol=1e-6, atol=1e-7)
    assert np.any(np.abs(linear) == 1) and np.any((linear != 0) & (np.abs(linear) < 1))


def test_joint_velocities_are_rates_of_the_angles() -> None:
    still = jax.jit(ANT.fixed_state)()
    pushed = np.zeros(8, np.float32)
    pushed[0] = 0.05
    before, after = (
        np.asarray(x.obs) for x in (still, jax.jit(ANT.step)(still, pushed))
    )
    rate = (after[5] - before[5]) / ANT.dt
    assert rate > 0
    assert after[19] > 0


def test_reward_and_metrics(rolled: tuple[State, State, np.ndarray]) -> None:
    before, after, actions = rolled
    start, end = before.pipeline_state, after.pipeline_state
    velocity = (end.q[..., :2] - start.q[..., :2]) / 0.05
    control = 0.5 * np.sum(actions**2, axis=-1)
    changes = np.clip(end.impulse[..., :3] / ANT.system.mass[:, None], -1, 1)
    contact = 5e-4 * np.sum(changes**2, axis=(-2, -1))
    expected = {
        "reward_forward": velocity[..., 0],
        "forward_reward": velocity[..., 0],
        "x_velocity": velocity[..., 0],
        "y_velocity": velocity[..., 1],
        "reward_survive": np.ones_like(control),
        "reward_ctrl": -control,
        "reward_contact": -contact,
        "x_position": end.q[..., 0],
        "y_position": end.q[..., 1],
        "distance_from_origin": np.linalg.norm(end.q[..., :3], axis=-1),
    }
    assert set(after.metrics) == set(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(after.metrics[name], value, rtol=1e-5, atol=1e-6)
    reward = velocity[..., 0] + 1 - control - contact
    np.testing.assert_allclose(after.reward, reward, rtol=1e-5, atol=1e-5)
    assert np.any(contact > 0)


@functools.cache
def lasting() -> Ant:
    """A fall does not end its episodes."""
    return Ant(terminate_when_unhealthy=False, healthy_reward=2.0)


@pytest.mark.parametrize(
    ("height", "healthy"), [(0.9, True), (1.1, False), (2.0, False)]
)
def test_unhealthy_heights_end_the_episode(height: float, healthy: bool) -> None:
    ends = raised(ANT)(height)
    assert bool(ends.done) is not healthy
    assert float(ends.metrics["reward_survive"]) == 1.0
    goes_on = raised(lasting())(height)
    assert float(goes_on.done) == 0.0
    assert float(goes_on.metrics["reward_survive"]) == (2.0 if healthy else 0.0)


def test_a_low_torso_ends_the_episode() -> None:
    high = Ant(healthy_z_range=(0.6, 1.0))
    assert float(raised(high)(0.55).done) == 1.0
    assert float(raised(high)(0.8).done) == 0.0


def test_weights_scale_the_costs() -> None:
    dear = Ant(ctrl_cost_weight=2.0, contact_cost_weight=1.0)
    state = dear.fixed_state()
    ones = jnp.ones(8, np.float32)
    dear_step, cheap_step = (
        jax.jit(dear.step)(state, ones),
        jax.jit(ANT.step)(state, ones),
    )
    assert float(dear_step.metrics["reward_ctrl"]) == -16.0
    assert float(cheap_step.metrics["reward_ctrl"]) == -4.0
    np.testing.assert_allclose(
        dear_step.metrics["reward_contact"],
        2000 * cheap_step.metrics["reward_contact"],
        rtol=1e-5,
    )


def test_blocks_can_be_left_out_and_added() -> None:
    env = Ant(
        use_contact_forces=False, exclude_current_positions_from_observation=False
    )
    names = [name for name, _ in env.observation_layout]
    assert env.observation_size == 29
    assert names[0] == "torso position x y [m]" and "contact" not in " ".join(names)
    assert sum(size for _, size in ANT.observation_layout) == 87


def test_distance_has_a_gradient_at_the_origin() -> None:
    gradient = jax.jit(jax.grad(length))
    assert gradient(np.zeros(3)).tolist() == [0.0, 0.0, 0.0]
    np.testing.assert_allclose(gradient(np.array([3.0, 0.0, 4.0])), [0.6, 0, 0.8])


@pytest.mark.parametrize("entry", [(4, 1, 1), (4, 0, 1), (4, 0, 0), (4,)])
def test_inertia_must_be_the_same_about_every_axis(entry: tuple[int, ...]) -> None:
    inertia = np.array(ANT.system.inertia)
    inertia[entry] = 2.0 if entry in ((4, 1, 1), (4, 0, 1)) else 0.0
    system = dataclasses.replace(ANT.system, inertia=inertia)
    with pytest.raises(
        ValueError,
        match=r"^use_contact_forces=True: .* link 'foot_2' .*allowed: positive",
    ):
        isotropic_inertia(system, np.arange(system.nb), "use_contact_forces=True")
