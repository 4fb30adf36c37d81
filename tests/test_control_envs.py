"""Pendulums, acrobot, arms, swimmer, standing up: tasks reckoned in NumPy."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contract import same
from control_tasks import (
    agree,
    bodies,
    make,
    metrics_are,
    moving,
    play,
    point,
    rolled,
    thrown,
)
from physics_helpers import directional_errors, report
from test_pusher import presses

import newton_qd
from newton_qd.brax_views import BraxViewsWrapper
from newton_qd.envs import Humanoid
from newton_qd.envs.state import State
from newton_qd.physics import reference

NAMES = (
    "acrobot",
    "fetch",
    "grasp",
    "arm_reach",
    "humanoidstandup",
    "inverted_double_pendulum",
    "inverted_pendulum",
    "pusher",
    "pusher_uni",
    "reacher",
    "reacherangle",
    "swimmer",
    "ur5e",
)
REACHERS = ("reacher", "reacherangle")
# One with a drawn target; the others run with the slow tests.
EVERY_NAME = [
    pytest.param(n, marks=() if n == "reacher" else pytest.mark.slow) for n in NAMES
]


def wrap(angle: np.ndarray) -> np.ndarray:
    return np.arctan2(np.sin(angle), np.cos(angle))


def test_inverted_pendulum() -> None:
    _, after, _ = rolled("inverted_pendulum")
    q, v = after.pipeline_state.q, after.pipeline_state.v
    expected = np.stack([q[..., 0], wrap(q[..., 1]), v[..., 0], v[..., 1]], axis=-1)
    agree(after.obs, expected)
    np.testing.assert_array_equal(after.reward, np.ones_like(after.reward))
    np.testing.assert_array_equal(after.done, np.abs(wrap(q[..., 1])) > 0.2)
    assert 0 < after.done.mean() < 1
    metrics_are(after, {})


def test_inverted_double_pendulum() -> None:
    _, after, _ = rolled("inverted_double_pendulum")
    q, v = after.pipeline_state.q, after.pipeline_state.v
    sines = [np.sin(q[..., 1:]), np.cos(q[..., 1:])]
    agree(after.obs, np.concatenate([q[..., :1], *sines, v], axis=-1))
    tip = point(bodies("inverted_double_pendulum", after)["pole2"][0], (0, 0, 0.6))
    x, height = tip[..., 0], tip[..., 2]
    reward = 10 - 0.01 * x**2 - (height - 2) ** 2
    agree(after.reward, reward - 1e-3 * v[..., 1] ** 2 - 5e-3 * v[..., 2] ** 2, 10.0)
    np.testing.assert_array_equal(after.done, height <= 1)
    assert 0 < after.done.mean() < 1
    upright = jax.jit(make("inverted_double_pendulum").fixed_state)()
    agree(upright.obs, [0, 0, 0, 1, 1, 0, 0, 0])


def test_acrobot() -> None:
    _, after, _ = rolled("acrobot")
    angle, v = wrap(after.pipeline_state.q), after.pipeline_state.v
    agree(after.obs, np.concatenate([angle, v], axis=-1))
    distance, speed = np.sum(angle**2, -1), 1e-3 * np.sum(v**2, -1)
    agree(after.reward, 10 - distance - speed, 10.0)
    assert not after.done.any()
    zero = np.zeros_like(speed)
    expected = {"dist_penalty": distance, "vel_penalty": speed, "alive_bonus": zero}
    metrics_are(after, {**expected, "r_tot": 10 - distance - speed})
    hanging = jax.jit(make("acrobot").fixed_state)().obs
    agree(np.abs(hanging), [np.pi, 0, 0, 0])


@pytest.mark.parametrize("name", REACHERS)
def test_reachers(name: str) -> None:
    _, after, actions = rolled(name)
    q, links = after.pipeline_state.q, bodies(name, after)
    frame, twist = links["body1"]
    tip = point(frame, (0.11, 0, 0))
    velocity = twist[..., :3] + np.cross(twist[..., 3:], tip - frame[..., :3])
    miss = tip - links["target"][0][..., :3]
    turns = [np.cos(q[..., :2]), np.sin(q[..., :2])]
    blocks = [*turns, q[..., 2:], velocity[..., :2], miss]
    agree(after.obs, np.concatenate(blocks, axis=-1))
    distance, control = np.linalg.norm(miss, axis=-1), np.sum(actions**2, axis=-1)
    assert not after.done.any()
    if name == "reacher":
        metrics_are(after, {"reward_dist": -distance, "reward_ctrl": -control})
        agree(after.reward, -distance - control)
    else:
        metrics_are(after, {"rewardDist": -distance, "rewardCtrl": 0 * control})
        agree(after.reward, -distance)


@pytest.mark.parametrize("name", REACHERS)
def test_target_is_drawn_and_stays(name: str) -> None:
    env = make(name)
    keys = jax.random.split(jax.random.key(0), 2000)
    state = jax.jit(jax.vmap(env.reset))(keys)
    q, v = (np.asarray(x) for x in (state.pipeline_state.q, state.pipeline_state.v))
    radius = np.linalg.norm(q[:, 2:], axis=1)
    assert 0.19 < radius.max() <= 0.2 and not v[:, 2:].any()
    # uniform in the radius, or uniform over the disk
    assert np.mean(radius) == pytest.approx(0.1 if name == "reacher" else 2 / 15, 0.03)
    assert np.abs(np.mean(q[:, 2:], axis=0)).max() < 0.01
    assert 0.09 < np.abs(q[:, :2]).max() <= 0.1 * (1 + 1e-6)
    assert 0.0045 < np.abs(v[:, :2]).max() <= 0.005 * (1 + 1e-6)
    viewed: Any = BraxViewsWrapper(env)
    row = viewed.sys.body.index["target"]
    found = jax.jit(jax.vmap(lambda key: viewed.reset(key).qp.pos))(keys)[:, row]
    np.testing.assert_allclose(found[:, :2], q[:, 2:], atol=1e-7)
    np.testing.assert_allclose(found[:, 2], 0.01, atol=1e-7)
    quiet = make(name, reset_noise_scale=0.0, reset_velocity_noise_scale=0.0)
    start = jax.device_get(jax.jit(quiet.reset)(jax.random.key(1))).pipeline_state
    assert not np.any(start.q[:2]) and not np.any(start.v)
    still = rolled(name)
    v = np.array(still[0].pipeline_state.v[0])
    v[:, 2:] = 0
    moved = dataclasses.replace(
        jax.tree.map(lambda x: x[0], still[0].pipeline_state), v=jnp.asarray(v)
    )
    first = jax.tree.map(lambda x: x[0], still[0]).replace(pipeline_state=moved)
    end = play(env)(first, still[2])[1].pipeline_state
    assert same(end.q[-1][:, 2:], jnp.asarray(moved.q)[:, 2:])


def test_servos_come_to_their_angle() -> None:
    """An action of 1 is half a turn; beyond it is clipped; clipped has no gradient."""
    env = make("reacherangle")
    actions = np.array([[0.5, -0.25], [0.5, -0.25], [3.0, -3.0]], np.float32)
    keys = jax.random.split(jax.random.key(0), 3)
    state = jax.jit(jax.vmap(env.reset))(keys)
    end = play(env)(state, np.tile(actions, (400, 1, 1)))[1]
    held = np.pi * np.clip(actions, -1, 1)
    np.testing.assert_allclose(end.pipeline_state.q[-1][:, :2], held, atol=1e-3)


@pytest.mark.parametrize("exclude", [True, False])
def test_swimmer(exclude: bool) -> None:
    option = {} if exclude else {"exclude_current_positions_from_observation": False}
    before, after, actions = rolled("swimmer", **option)
    q, v = after.pipeline_state.q, after.pipeline_state.v
    first = [] if exclude else [q[..., :2]]
    blocks = [*first, wrap(q[..., 2:3]), q[..., 3:], v]
    agree(after.obs, np.concatenate(blocks, axis=-1))
    assert make("swimmer").action_size == 2
    centres = []
    for state in (before, after):
        links = bodies("swimmer", state)
        offsets = {"torso": 0.0, "mid": 0.5, "back": 0.5}
        found = [point(links[n][0], (x, 0, 0)) for n, x in offsets.items()]
        centres.append(np.mean(found, axis=0))
    velocity = (centres[1] - centres[0]) / 0.04
    control = 1e-4 * np.sum(actions**2, axis=-1)
    np.testing.assert_allclose(after.reward, velocity[..., 0] - control, atol=3e-4)
    expected = {
        "reward_ctrl": -control,
        "x_position": centres[1][..., 0],
        "y_position": centres[1][..., 1],
        "distance_from_origin": np.linalg.norm(
            np.append(q[..., :2], np.full((*q.shape[:2], 1), 0.1), axis=-1), axis=-1
        ),
    }
    for key, value in expected.items():
        agree(after.metrics[key], value)
    for key, axis in (("reward_fwd", 0), ("forward_reward", 0), ("x_velocity", 0)):
        np.testing.assert_allclose(
            after.metrics[key], velocity[..., axis], atol=3e-4, rtol=1e-4
        )
    assert not after.done.any()


def test_swimmer_weights() -> None:
    _, plain, _ = rolled("swimmer")
    _, after, _ = rolled("swimmer", forward_reward_weight=3.0, ctrl_cost_weight=0.5)
    agree(after.metrics["reward_fwd"], 3 * plain.metrics["reward_fwd"])
    agree(after.metrics["reward_ctrl"], 5000 * plain.metrics["reward_ctrl"])
    assert np.any(plain.metrics["reward_fwd"]) and np.any(plain.metrics["reward_ctrl"])


def test_drag_is_that_of_the_links() -> None:
    """Generalized force J^T F, of coefficients computed by hand from the original's."""
    env = make("swimmer")
    system, rng = env.system, np.random.default_rng(3)

    @jax.jit
    def forces(q: jax.Array, v: jax.Array) -> jax.Array:
        state = newton_qd.physics.initial_state(system, q, v)
        return env.control(state, jnp.zeros(2, np.float32))

    for _ in range(5):
        q, v = rng.normal(size=5).astype(np.float32), rng.normal(size=5)
        v = v.astype(np.float32)
        control = np.asarray(forces(q, v))
        linear, _ = reference.jacobians(system, q)
        expected = np.zeros(5)
        for body, angle in zip((2, 3, 4), np.cumsum(q[2:].astype(float)), strict=True):
            axis = np.array([np.cos(angle), np.sin(angle), 0])
            side = np.array([-axis[1], axis[0], 0])
            moving = linear[body] @ v
            force = -0.07573372 * moving
            for along, drag in ((axis, 0.00416670), (side, 0.02646079)):
                force -= drag * abs(moving @ along) * (moving @ along) * along
            expected += linear[body].T @ force
        felt = control[[2, 3, 4, 0, 1]] * system.gear[[2, 3, 4, 0, 1]]
        np.testing.assert_allclose(felt, expected, rtol=1e-4, atol=1e-6)


def test_humanoid_standup() -> None:
    _, after, actions = rolled("humanoidstandup")
    control = 0.01 * np.sum(actions**2, axis=-1)
    up = after.pipeline_state.q[..., 2] / 0.015
    metrics_are(after, {"reward_linup": up, "reward_quadctrl": -control})
    agree(after.reward, up + 1 - control, 10.0)
    assert not after.done.any()
    assert make("humanoidstandup").observation_layout == Humanoid().observation_layout


def test_standing_up_starts_at_rest_on_the_back() -> None:
    """Left alone it stays low, and nothing throws it."""
    env = make("humanoidstandup")
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 2))
    path = play(env)(state, np.zeros((100, 2, 17), np.float32))[1].pipeline_state
    assert np.abs(path.v).max() < 10.0
    assert 0.0 < np.min(path.q[..., 2]) and np.max(path.q[..., 2]) < 0.4
    assert np.any(path.impulse[-1] != 0)


@pytest.mark.parametrize("name", EVERY_NAME)
def test_a_world_does_not_depend_on_its_batch(name: str) -> None:
    env = make(name)
    state, actions = thrown(env, 16)
    batch = play(env)(state, actions)[1]
    alone = play(env)(jax.tree.map(lambda x: x[5:6], state), actions[:, 5:6])[1]
    assert same(alone, jax.tree.map(lambda x: x[:, 5:6], batch))


# those with a control or roots of their own; the rest is the base's
@pytest.mark.parametrize(
    "name", [pytest.param("swimmer", marks=pytest.mark.slow), "reacher"]
)
def test_a_fault_stays_in_its_world_and_has_no_gradient(name: str) -> None:
    env = make(name)
    state, actions = thrown(env, 3)
    q = state.pipeline_state.q.at[1, -1].set(jnp.nan)
    bad = dataclasses.replace(state.pipeline_state, q=q)

    def total(physics: Any) -> jax.Array:
        states = play(env)(state.replace(pipeline_state=physics), actions)[1]
        return states.reward.sum() + jnp.sin(states.obs).sum()

    after = play(env)(state.replace(pipeline_state=bad), actions)[1]
    assert after.info["fault"][-1].tolist() == [0, 1, 0]
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(after))
    gradient = jax.jit(jax.grad(total))(bad)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))
    assert not np.any(gradient.q[1]) and np.any(gradient.q[0])


def test_a_swimmer_that_is_nowhere_has_a_finite_gradient() -> None:
    env = make("swimmer")
    action = np.ones(env.action_size, env.dtype)

    def reward(q: jax.Array) -> jax.Array:
        state = env.fixed_state()
        lost = dataclasses.replace(state.pipeline_state, q=q)
        return env.step(state.replace(pipeline_state=lost), action).reward

    q = env.system.rest_q.astype(env.dtype)
    q[3] = np.nan
    assert not np.any(jax.jit(jax.grad(reward))(q))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_gradient_of_an_episode(name: str, x64: None) -> None:
    """Of 16 steps' rewards, last observation and last state descriptor."""
    env = make(name, dtype="float64")
    start, _ = thrown(env, 50)
    if name.startswith("pusher"):
        start = start.replace(pipeline_state=moving(env, *presses(50)[:2]))
    size = 16 * env.action_size
    actions = np.random.default_rng(1).uniform(-0.9, 0.9, (50, size))
    first = jax.tree.map(lambda x: x[0], start)

    def total(q: jax.Array, v: jax.Array, actions: jax.Array) -> jax.Array:
        def advance(state: State, action: jax.Array) -> tuple[State, jax.Array]:
            state = env.step(state, action)
            return state, state.reward

        physics = newton_qd.physics.initial_state(env.system, q, v)
        state = first.replace(pipeline_state=physics)
        last, rewards = jax.lax.scan(advance, state, actions.reshape(16, -1))
        described = last.info.get("state_descriptor", jnp.zeros(0))
        return rewards.sum() + jnp.sin(last.obs).sum() + jnp.sin(described).sum()

    physics = start.pipeline_state
    inputs = tuple(np.asarray(x) for x in (physics.q, physics.v, actions))
    errors = directional_errors(total, inputs)
    report("largest error for q, v, actions", errors.max(axis=1))
    assert errors.max() < 1e-4


@pytest.mark.parametrize("name", EVERY_NAME)
def test_a_thousand_random_steps_are_finite(name: str) -> None:
    env = make(name, auto_reset=True)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 8))
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (1000, 8, env.action_size)).astype(np.float32)
    states = play(env)(state, actions)[1]
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(states))
    assert not np.any(states.info["fault"])


@pytest.mark.parametrize("name", NAMES)
def test_fixed_initial_state_and_unknown_options(name: str) -> None:
    env = newton_qd.create(name, fixed_init_state=True, batch_size=2)
    reset = jax.jit(env.reset)
    state = reset(jax.random.key(0))
    assert same(state.obs, reset(jax.random.key(1)).obs)
    assert not np.any(np.asarray(state.pipeline_state.v))
    with pytest.raises(
        TypeError, match=r"legacy_spring: got True.*reset_noise_scale, "
    ):
        newton_qd.create(name, legacy_spring=True)
