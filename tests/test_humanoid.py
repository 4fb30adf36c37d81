"""The humanoid's observation, reward and end, reckoned again in NumPy."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics_helpers import random_states
from torso_heights import raised

from newton_qd import physics
from newton_qd.envs.base import State
from newton_qd.envs.humanoid import Humanoid
from newton_qd.envs.humanoid_trap import HumanoidTrap
from newton_qd.physics import reference
from newton_qd.physics.system import System
from newton_qd.robots import HUMANOID

BODIES = (
    *("torso", "lwaist", "pelvis"),
    *("right_thigh", "right_shin", "left_thigh", "left_shin"),
    *("right_upper_arm", "right_lower_arm", "left_upper_arm", "left_lower_arm"),
)
# Actions in the order in which their joints and torques are observed.
OBSERVED = (2, 6, 10, 13, 16, 0, 1, 11, 12, 14, 15, 3, 4, 5, 7, 8, 9)
GEARS = np.array([350.0] * 11 + [100.0] * 6)
# Joint angles in the order of observation, as the original prints them.
REST_ANGLES = (
    *(0, -0.43633, -0.43633, -0.34907, -0.34907),
    *(0, -0.3927, -0.21817, -0.21817, 0.21817, 0.21817),
    *(0, 0.34907, 0, 0, 0.34907, 0),
)
WORLDS, STEPS = 6, 11
CHECKED = [(step, world) for step in (0, 4, 10) for world in range(WORLDS)]
Rolled = tuple[State, State, np.ndarray]


# made by the tests, because every process that collects them would wait for these
@functools.cache
def humanoid() -> Humanoid:
    return Humanoid()


@functools.cache
def trapped() -> HumanoidTrap:
    return HumanoidTrap()


def roll(env: Humanoid) -> Rolled:
    """States before and after each step of random states, and the actions."""
    system = env.system
    q, v, _ = random_states(system, np.random.default_rng(0), WORLDS)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), WORLDS))
    start = jax.jit(jax.vmap(lambda q, v: physics.initial_state(system, q, v)))(q, v)
    state = state.replace(pipeline_state=start)
    shape = (STEPS, WORLDS, env.action_size)
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, shape)

    def advance(state: State, action: jax.Array) -> tuple[State, tuple[State, State]]:
        after = jax.vmap(env.step)(state, action)
        return after, (state, after)

    states: Any = jax.jit(lambda s, a: jax.lax.scan(advance, s, a)[1])(state, actions)
    before, after = jax.tree.map(np.asarray, states)
    return before, after, actions


@pytest.fixture(scope="module")
def rolled() -> Rolled:
    with jax.enable_x64(True):
        return roll(Humanoid(dtype="float64"))


@pytest.fixture(scope="module")
def rolled_trap() -> Rolled:
    with jax.enable_x64(True):
        return roll(HumanoidTrap(dtype="float64"))


def solid(system: System) -> list[int]:
    return [system.body_names.index(name) for name in BODIES]


def bodies_of(
    system: System, q: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity of the centre of mass of every body with mass, (11, 3)."""
    frames = reference.body_frames(system, q)
    linear, _ = reference.jacobians(system, q)
    rows = solid(system)
    positions = [
        frames[row, :3] + reference.rotation_matrix(frames[row, 3:]) @ system.com[row]
        for row in rows
    ]
    return np.array(positions), (linear @ np.asarray(v, np.float64))[rows]


def centre(system: System, q: np.ndarray) -> np.ndarray:
    positions, _ = bodies_of(system, q, np.zeros(system.nv))
    return np.average(positions, axis=0, weights=system.mass[solid(system)])


def expected_observation(
    env: Humanoid, state: Any, action: np.ndarray, scaled: bool
) -> np.ndarray:
    """Observation of one world; ``scaled``: the products of inertia have the mass."""
    system, order = env.system, np.array(OBSERVED)
    q, v = np.asarray(state.q, np.float64), np.asarray(state.v, np.float64)
    joints = np.array(
        [system.joint_names.index(name) for name, _ in HUMANOID.actuators]
    )
    positions, velocities = bodies_of(system, q, v)
    mass = system.mass[solid(system)]
    arms = positions - np.average(positions, axis=0, weights=mass)
    inertia, share, turning = [], [], []
    for m, arm, velocity in zip(mass, arms, velocities, strict=True):
        square = arm @ arm
        products = np.outer(arm, arm) * (m if scaled else 1.0)
        inertia.append((m * square * np.eye(3) + np.eye(3) - products).ravel())
        share.append(m * velocity / mass.sum())
        turning.append(np.cross(arm, velocity) / (1e-7 + square))
    return np.concatenate(
        [
            q[2:3],
            q[[6, 3, 4, 5]],
            q[system.q_start[joints]][order],
            v[:6],
            v[system.v_start[joints]][order],
            *inertia,
            *share,
            *turning,
            (action * GEARS)[order],
        ]
    )


def at(tree: Any, index: tuple[int, int]) -> Any:
    """One step of one world."""
    return jax.tree.map(lambda x: x[index], tree)


def close(ours: Any, theirs: Any, worst: float = 1e-9) -> None:
    np.testing.assert_allclose(ours, theirs, rtol=worst, atol=worst)


def test_fixed_observation_is_that_of_the_original() -> None:
    observed = np.asarray(jax.jit(humanoid().fixed_state)().obs)
    assert observed.shape == (227,)
    expected = [1.24392, 1, 0, 0, 0, *REST_ANGLES, *[0] * 23]
    np.testing.assert_allclose(observed[:45], expected, atol=1e-5)
    assert not observed[144:].any()


def test_layout() -> None:
    sizes = [size for _, size in humanoid().observation_layout]
    assert sizes == [1, 4, 17, 3, 3, 17, 99, 33, 33, 17]
    assert (humanoid().observation_size, humanoid().action_size) == (227, 17)
    assert humanoid().name == "humanoid" and humanoid().dt == 0.015


def test_observation(rolled: Rolled) -> None:
    _, after, actions = rolled
    for index in CHECKED:
        state = at(after, index)
        expected = expected_observation(
            humanoid(), state.pipeline_state, actions[index], scaled=False
        )
        close(state.obs, expected)


def test_reward_and_metrics(rolled: Rolled) -> None:
    before, after, actions = rolled
    for index in CHECKED:
        start, end = (
            centre(humanoid().system, at(s, index).pipeline_state.q)
            for s in (before, after)
        )
        vx, vy, _ = (end - start) / 0.015
        cost = 0.1 * np.sum(actions[index] ** 2)
        expected = {
            "forward_reward": 1.25 * vx,
            "reward_linvel": 1.25 * vx,
            "reward_quadctrl": -cost,
            "reward_alive": 5.0,
            "x_position": end[0],
            "y_position": end[1],
            "distance_from_origin": np.linalg.norm(end),
            "x_velocity": vx,
            "y_velocity": vy,
        }
        assert set(after.metrics) == set(expected)
        for name, value in expected.items():
            close(after.metrics[name][index], value)
        close(after.reward[index], 1.25 * vx + 5.0 - cost)
    height = after.pipeline_state.q[..., 2]
    np.testing.assert_array_equal(after.done, (height < 0.8) | (height > 2.1))
    assert 0 < after.done.mean() < 1


def test_reset_noise_is_on_the_joints_alone() -> None:
    keys = jax.random.split(jax.random.key(0), 256)
    state = jax.jit(jax.vmap(humanoid().reset))(keys).pipeline_state
    q, v = np.asarray(state.q), np.asarray(state.v)
    assert np.all(q[:, :2] == 0) and np.all(q[:, 3:7] == [0, 0, 0, 1])
    assert np.all(v[:, :6] == 0)
    for noise in (q[:, 7:] - humanoid().system.rest_q[7:], v[:, 6:]):
        assert np.all(np.abs(noise) <= 0.01 + 1e-6)
        assert np.all(np.abs(noise).max(axis=0) > 0.009)
    lowest_contact = functools.partial(physics.lowest_contact, humanoid().system)
    lowest = jax.jit(jax.vmap(lowest_contact))(state.q)
    np.testing.assert_allclose(lowest, 0.0, atol=1e-6)


def test_first_observation_has_no_torques() -> None:
    state = jax.jit(humanoid().reset)(jax.random.key(0))
    assert not np.asarray(state.obs[210:]).any()
    assert float(state.reward) == float(state.done) == 0.0


@functools.cache
def lasting() -> Humanoid:
    """A fall does not end its episodes."""
    return Humanoid(terminate_when_unhealthy=False, healthy_reward=2.0)


@pytest.mark.parametrize(("height", "healthy"), [(1.5, True), (2.2, False)])
def test_unhealthy_heights_end_the_episode(height: float, healthy: bool) -> None:
    ends = raised(humanoid())(height)
    assert bool(ends.done) is not healthy
    assert float(ends.metrics["reward_alive"]) == 5.0
    goes_on = raised(lasting())(height)
    assert float(goes_on.done) == 0.0
    assert float(goes_on.metrics["reward_alive"]) == (2.0 if healthy else 0.0)


def test_a_low_torso_ends_the_episode() -> None:
    high = Humanoid(healthy_z_range=(1.6, 2.1))
    assert float(raised(high)(1.5).done) == 1.0
    assert float(raised(high)(1.8).done) == 0.0


def test_weights_and_positions_can_be_chosen() -> None:
    env = Humanoid(
        forward_reward_weight=2.5,
        ctrl_cost_weight=1.0,
        exclude_current_positions_from_observation=False,
    )
    assert env.observation_size == 229
    assert env.observation_layout[0] == ("torso position x y [m]", 2)
    ones = jnp.ones(17, np.float32)
    dear, cheap = (
        jax.device_get(jax.jit(lambda e=e: e.step(e.fixed_state(), ones))())
        for e in (env, humanoid())
    )
    close(dear.metrics["reward_quadctrl"], -17.0, 1e-6)
    close(cheap.metrics["reward_quadctrl"], -1.7, 1e-6)
    assert float(cheap.metrics["reward_linvel"]) != 0.0
    close(dear.metrics["reward_linvel"], 2 * cheap.metrics["reward_linvel"], 1e-6)
    np.testing.assert_array_equal(dear.obs[2:], cheap.obs)
    np.testing.assert_array_equal(dear.obs[:2], dear.pipeline_state.q[:2])


@pytest.mark.parametrize("make", [Humanoid, HumanoidTrap])
def test_unknown_options_are_refused(make: Callable[..., Humanoid]) -> None:
    with pytest.raises(TypeError, match="ctrl_weight"):
        make(ctrl_weight=1.0)


@pytest.mark.slow
def test_a_world_at_fault_observes_no_torque() -> None:
    state = humanoid().fixed_state()
    bad = jnp.full(17, 0.5, np.float32).at[3].set(jnp.nan)
    ends = jax.jit(humanoid().step)(state, bad)
    assert int(ends.info["fault"]) == 1 and float(ends.done) == 1.0
    np.testing.assert_array_equal(ends.obs, state.obs)
    good = jnp.full(17, 0.5, np.float32)
    gradient = jax.grad(lambda u: humanoid().step(ends, u).obs.sum())(good)
    assert not np.asarray(gradient).any()


# What the trap task changes.


def test_observation_of_the_trap_task(rolled_trap: Rolled) -> None:
    _, after, actions = rolled_trap
    assert trapped().observation_size == 227 + 2 * 3 * 13
    rows = solid(trapped().system)
    mass = trapped().system.mass[rows, None]
    seen = []
    for index in CHECKED:
        state = at(after, index)
        expected = expected_observation(
            trapped(), state.pipeline_state, actions[index], scaled=True
        )
        close(state.obs[:227], expected)
        linear = state.pipeline_state.impulse[rows, :3] / mass
        angular = state.pipeline_state.impulse[rows, 3:]  # 1 kg m^2
        still = np.zeros((2, 3))  # floor and trap
        contact = np.concatenate([linear, still, angular, still]).ravel()
        close(state.obs[227:], contact)
        seen.append(linear)
    assert np.abs(seen).max() > 1  # it is not clipped


def test_size_of_the_trap_task() -> None:
    assert HumanoidTrap().observation_size == 305
    assert HumanoidTrap().system.scene_links == ("trap",)


def test_reward_of_the_trap_task(rolled_trap: Rolled, rolled: Rolled) -> None:
    _, after, actions = rolled_trap
    _, plain, _ = rolled
    cost = 0.01 * np.sum(actions**2, axis=-1)
    assert trapped().name == "humanoid_w_trap"
    linvel = plain.metrics["reward_linvel"]  # the same actions move it as far
    close(after.metrics["reward_linvel"], linvel)
    close(after.metrics["reward_quadctrl"], cost)
    assert np.all(after.metrics["reward_alive"] == 5.0)
    assert np.all(after.metrics["reward_impact"] == 0.0)
    assert len(after.metrics) == 4
    close(after.reward, linvel + 5.0 - cost)
    np.testing.assert_array_equal(after.done, plain.done)
