"""QD tasks that the original does not have, reckoned in NumPy."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from control_tasks import agree, bodies, make, metrics_are, play, point, rolled
from physics_helpers import report

from newton_qd import physics
from newton_qd.physics import reference
from newton_qd.physics.system import System
from newton_qd.robots import PUSHER, PUSHER_TABLE, QUADRUPED
from newton_qd.wrappers import XYPositionWrapper


def test_arm_reach() -> None:
    _, after, actions = rolled("arm_reach")
    q, v = after.pipeline_state.q, after.pipeline_state.v
    frame, twist = bodies("arm_reach", after)["body1"]
    tip = point(frame, (0.11, 0, 0))
    velocity = twist[..., :3] + np.cross(twist[..., 3:], tip - frame[..., :3])
    turns = [np.cos(q[..., :2]), np.sin(q[..., :2]), v[..., :2]]
    blocks = [*turns, tip[..., :2], velocity[..., :2]]
    agree(after.obs, np.concatenate(blocks, axis=-1))
    effort = np.sum(actions**2, axis=-1)
    metrics_are(after, {"reward_ctrl": -effort})
    agree(after.reward, -effort)
    assert not after.done.any()
    agree(after.info["xy_position"], tip[..., :2])
    limits = np.float32(-0.21), np.float32(0.21)
    found = after.info["state_descriptor"]
    np.testing.assert_array_equal(found, np.clip(after.info["xy_position"], *limits))
    # a batch inside of the wrapper reads the same points
    wrapper = make("arm_reach")
    assert isinstance(wrapper, XYPositionWrapper)
    read = jax.jit(wrapper._described)(after).info["xy_position"]
    np.testing.assert_allclose(read, after.info["xy_position"], atol=1e-7)


@pytest.mark.slow
def test_pusher_uni() -> None:
    before, after, actions = rolled("pusher_uni")
    q, v = after.pipeline_state.q, after.pipeline_state.v
    (old_hand, old_pushed), (hand, pushed) = (
        [links[name][0][..., :3] for name in ("r_wrist_roll_link", "object")]
        for links in (bodies("pusher_uni", before), bodies("pusher_uni", after))
    )
    blocks = [q[..., :7], v[..., :7], hand, pushed[..., :2]]
    agree(after.obs, np.concatenate(blocks, axis=-1))
    near = np.linalg.norm(old_pushed - old_hand, axis=-1)
    effort = np.sum(actions**2, axis=-1)
    metrics_are(after, {"reward_ctrl": -effort, "reward_near": -near})
    agree(after.reward, -0.1 * effort - 0.5 * near, 5.0)
    assert not after.done.any()
    expected = np.clip(pushed[..., :2], -1, 1)
    agree(after.info["state_descriptor"], expected)
    # where no arm pushes the object, each of ten substeps divides its velocity
    row = make("pusher_uni").system.body_names.index("object")
    alone = ~after.pipeline_state.impulse[..., row, :2].any(axis=-1)
    assert alone.mean() > 0.3
    slower = before.pipeline_state.v[..., 7:] / (1 + 0.005 * 2.0) ** 10
    agree(v[alone][:, 7:], slower[alone])


def test_the_table_is_all_that_differs_from_the_pusher() -> None:
    plain, table = (physics.load_system(robot) for robot in (PUSHER, PUSHER_TABLE))
    other = {"robot", "damping", "scene_links", "scene_frames"}
    for field in dataclasses.fields(System):
        found, expected = (getattr(one, field.name) for one in (table, plain))
        if field.name not in other and isinstance(found, np.ndarray):
            np.testing.assert_array_equal(found, expected, err_msg=field.name)
    assert table.damping.tolist() == [*plain.damping[:7].tolist(), 2.0, 2.0]


def test_quadruped() -> None:
    """It stands without actions; some of a few random gaits carry it away."""
    env = make("quadruped")
    worlds, steps = 16, 100
    rng = np.random.default_rng(0)
    size, phase = rng.uniform(0, 1, (2, worlds, env.action_size))
    pace = rng.uniform(1, 2, (worlds, 1))
    time = env.dt * np.arange(steps)[:, None, None]
    actions = (0.8 * size * np.sin(2 * np.pi * (pace * time + phase))).astype("f")
    actions[:, :4] = 0
    keys = jax.random.split(jax.random.key(0), worlds)
    start = jax.jit(jax.vmap(env.reset))(keys)
    before, after = jax.tree.map(np.asarray, play(env)(start, actions))
    old, new = before.pipeline_state, after.pipeline_state
    still = new.q[-1, :4]
    # joints yield a little under the weight
    rest = env.system.rest_q
    assert np.abs(still[:, 7:] - rest[7:]).max() < 0.12
    assert np.abs(still[:, 2] - rest[2]).max() < 0.03
    assert np.abs(new.v[-1, :4]).max() < 1e-3
    assert new.feet_contact[-1, :4].all() and not after.done[:, :4].any()
    assert not after.info["fault"].any()
    standing = np.cumsum(after.done, axis=0) == 0
    away = np.linalg.norm(new.q[..., :2] - old.q[0, :, :2], axis=-1)
    report("farthest in 3 s without a fall [m]", (away * standing).max())
    assert (away * standing).max() > 0.5
    forward = (new.q[..., 0] - old.q[..., 0]) / env.dt
    effort = 0.1 * np.sum(actions**2, axis=-1)
    np.testing.assert_allclose(after.reward, forward + 1 - effort, atol=1e-4)
    np.testing.assert_array_equal(after.done, new.q[..., 2] < np.float32(0.12))
    q, v = new.q, new.v
    height_and_turn = [q[..., 2:3], q[..., 6:7], q[..., 3:6]]
    blocks = [*height_and_turn, q[..., 7:], v]
    agree(after.obs, np.concatenate(blocks, axis=-1))


def test_actions_of_the_quadruped_are_angles() -> None:
    """0 is the pose in which it stands; 1 and -1 are the ends of the range."""
    env = make("quadruped")
    system = env.system
    state = jax.jit(env.fixed_state)().pipeline_state
    actions = np.array([[0.0], [1.0], [-3.0]]) * np.ones(env.action_size)
    control = jax.jit(env.control)
    middle, high, low = (control(state, a.astype(np.float32)) for a in actions)
    dofs = system.control_dof
    np.testing.assert_allclose(middle, system.rest_q[dofs + 1], atol=1e-6)
    np.testing.assert_allclose(high, system.limit_upper[dofs], rtol=1e-6)
    np.testing.assert_allclose(low, system.limit_lower[dofs], rtol=1e-6)
    strong = np.full(env.action_size, 3e38, np.float32)
    reward = jax.jit(lambda state, action: env.outcome(state, state, action)[0])
    assert reward(state, strong) == pytest.approx(1 - 0.1 * env.action_size)


def test_the_quadruped_is_alike_on_both_sides() -> None:
    """12 kg, and each link has a twin of the same mass and inertia."""
    system = physics.load_system(QUADRUPED)
    assert system.mass.sum() == pytest.approx(12.0)
    names = system.body_names
    frames = reference.body_frames(system, system.rest_q)
    mirror = np.array([1.0, -1.0, 1.0])
    for body, name in enumerate(names):
        if "left" not in name:
            continue
        twin = names.index(name.replace("left", "right"))
        np.testing.assert_allclose(frames[twin, :3] * mirror, frames[body, :3])
        np.testing.assert_allclose(system.com[twin] * mirror, system.com[body])
        np.testing.assert_array_equal(system.inertia[twin], system.inertia[body])
        assert system.mass[twin] == system.mass[body]
