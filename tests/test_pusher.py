"""The pusher: its robot is the original's, and pushing keeps momentum.

Every link weighs 1 kg, has 1 kg m^2 about every axis, and has its frame at its joint.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from control_tasks import agree, bodies, metrics_are, rolled
from physics_helpers import batched_step, report

from newton_qd import physics
from newton_qd.assets import find_urdf
from newton_qd.brax_views import BraxViewsWrapper
from newton_qd.envs import Pusher, TablePusher
from newton_qd.physics import reference
from newton_qd.physics.model.description import read_description
from newton_qd.robots import PUSHER

Vector = tuple[float, float, float]
X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
ORIGIN = (0.0, 0.0, 0.0)


class Capsule(NamedTuple):
    """Radius and length with caps, both of a sphere its diameter; centre; axis."""

    radius: float
    length: float
    axis: Vector
    centre: Vector = ORIGIN


class Part(NamedTuple):
    """A link: joint, place in the parent, axis, limits [degrees], colliders."""

    joint: str
    offset: Vector
    axis: Vector
    limits: tuple[float, float]
    colliders: tuple[Capsule, ...]


PARTS = {
    "r_shoulder_pan_link": Part(
        "r_shoulder_pan_joint",
        (0, -0.6, 0.5),
        Z,
        (-130.94377, 98.239456),
        (Capsule(0.1, 0.8, Z, (0, 0, -0.1)),),
    ),
    "r_shoulder_lift_link": Part(
        "r_shoulder_lift_joint",
        (0.1, 0, 0),
        Y,
        (-30.000069, 80.0021),
        (Capsule(0.1, 0.4, Y),),
    ),
    "r_upper_arm_roll_link": Part(
        "r_upper_arm_roll_joint",
        ORIGIN,
        X,
        (-85.94367, 97.402824),
        (Capsule(0.02, 0.24, X), Capsule(0.06, 0.52, X, (0.2, 0, 0))),
    ),
    "r_elbow_flex_link": Part(
        "r_elbow_flex_joint",
        (0.4, 0, 0),
        Y,
        (-133.0007, 0),
        (Capsule(0.06, 0.16, Y),),
    ),
    "r_forearm_roll_link": Part(
        "r_forearm_roll_joint",
        ORIGIN,
        X,
        (-85.94367, 85.94367),
        (Capsule(0.02, 0.24, X), Capsule(0.05, 0.391, X, (0.1455, 0, 0))),
    ),
    "r_wrist_flex_link": Part(
        "r_wrist_flex_joint",
        (0.321, 0, 0),
        Y,
        (-62.681583, 0),
        (Capsule(0.01, 0.06, Y),),
    ),
    "r_wrist_roll_link": Part(
        "r_wrist_roll_joint",
        ORIGIN,
        X,
        (-85.94367, 85.94367),
        (
            Capsule(0.02, 0.24, Y),
            Capsule(0.02, 0.14, X, (0.05, -0.1, 0)),
            Capsule(0.02, 0.14, X, (0.05, 0.1, 0)),
            Capsule(0.01, 0.02, Z, (0.1, -0.1, 0)),
            Capsule(0.01, 0.02, Z, (0.1, 0.1, 0)),
        ),
    ),
}


def test_the_arm_is_the_originals() -> None:
    system, at = physics.load_system(PUSHER), np.zeros(3)
    bodies = read_description(find_urdf(PUSHER.urdf)).bodies
    for body, (name, part) in enumerate(PARTS.items()):
        assert (system.body_names[body], system.joint_names[body]) == (name, part.joint)
        assert (system.parent[body], system.mass[body]) == (body - 1, 1.0)
        np.testing.assert_array_equal(system.inertia[body], np.eye(3))
        np.testing.assert_array_equal(system.com[body], ORIGIN)
        np.testing.assert_array_equal(system.joint_axis[body], part.axis)
        at = at + part.offset
        frame = reference.body_frames(system, np.zeros(system.nq))[body]
        np.testing.assert_allclose(frame, [*at, 0, 0, 0, 1], atol=1e-15)
        limits = system.limit_lower[body], system.limit_upper[body]
        np.testing.assert_allclose(np.degrees(limits), part.limits, rtol=1e-12)
        assert (system.damping[body], system.gear[body]) == (20.0, 100.0)
        shapes = bodies[name].shapes
        for shape, capsule in zip(shapes, part.colliders, strict=True):
            straight = capsule.length / 2 - capsule.radius
            sizes = [capsule.radius, straight] if shape.kind == "capsule" else [0.01]
            np.testing.assert_allclose(shape.size[: len(sizes)], sizes, atol=1e-12)
            np.testing.assert_array_equal(shape.frame[:3], capsule.centre)
            along = reference.rotation_matrix(shape.frame[3:])[:, 2]
            np.testing.assert_allclose(along, capsule.axis, atol=1e-12)
    assert system.control_dof.tolist() == list(range(7))
    assert (PUSHER.dt, PUSHER.gravity, PUSHER.material.friction) == (0.05, 0.0, 0.0)


# The original's default pose, six digits: position, quaternion wxyz.
DEFAULT = {
    "mount": ((0, 0, 0.5), (1, 0, 0, 0)),
    "r_shoulder_lift_link": (
        (0.095955, -0.628154, 0.5),
        (0.966371, 0.030782, 0.214248, -0.138844),
    ),
    "r_upper_arm_roll_link": (
        (0.095955, -0.628154, 0.5),
        (0.963625, 0.079042, 0.207041, -0.149379),
    ),
    "r_forearm_roll_link": (
        (0.443811, -0.730218, 0.330946),
        (0.919384, -0.015802, -0.355206, -0.168262),
    ),
    "r_wrist_roll_link": (
        (0.665633, -0.82593, 0.542312),
        (0.78927, -0.060663, -0.590332, -0.157739),
    ),
}


def test_default_pose() -> None:
    """The object is where the mean of its resets is; the rest is the original's."""
    env: Any = BraxViewsWrapper(Pusher())
    qp = jax.device_get(jax.jit(lambda: env.fixed_state().qp)())
    index = env.sys.body.index
    for name, (place, rotation) in DEFAULT.items():
        np.testing.assert_allclose(qp.pos[index[name]], place, atol=2e-6)
        np.testing.assert_allclose(qp.rot[index[name]], rotation, atol=2e-6)
    np.testing.assert_allclose(qp.pos[index["object"]], (-0.15, 0, 0.05), atol=1e-7)
    np.testing.assert_allclose(qp.pos[index["goal"]], (0.45, 0.05, 0.05), atol=1e-7)
    assert env.sys.num_joint_dof == 7
    np.testing.assert_allclose(
        np.degrees(env.sys.default_angle()),
        [np.mean(part.limits) for part in PARTS.values()],
        atol=1e-5,
    )


def test_colliders_that_touch() -> None:
    """Forearm and hand touch the table and the object, the object the table."""
    system = physics.load_system(PUSHER)
    names = [system.body_names[body] for body in system.contact_body]
    table = [names[row] for row in system.ground_contacts]
    count = {name: table.count(name) for name in table}
    # both ends of a capsule
    expected = {"r_forearm_roll_link": 4, "r_wrist_roll_link": 8, "object": 1}
    assert count == expected
    pairs = [tuple(names[row] for row in pair) for pair in system.contact_pairs]
    assert len(pairs) == 7 and all("object" in pair for pair in pairs)
    assert sum("r_forearm_roll_link" in pair for pair in pairs) == 2
    assert sum("r_wrist_roll_link" in pair for pair in pairs) == 5
    assert len(names) == len(table) + 2 * len(pairs)


def presses(worlds: int) -> tuple[np.ndarray, ...]:
    """Moving arms, each with an end of a collider 1 to 5 mm deep in the object."""
    system, rng = physics.load_system(PUSHER), np.random.default_rng(0)
    pushed, tries = system.body_names.index("object"), 2000
    q = np.tile(system.rest_q, (tries, 1))
    q[:, :7] = rng.uniform(system.limit_lower[:7], system.limit_upper[:7], (tries, 7))
    look = jax.jit(jax.vmap(functools.partial(physics.forward_kinematics, system)))
    seen = look(q.astype(np.float32), np.zeros_like(q, np.float32))
    position, rotation = np.asarray(seen.position), np.asarray(seen.rotation)
    found = []
    for pair in system.contact_pairs:
        arm = next(row for row in pair if system.contact_body[row] < pushed)
        body = system.contact_body[arm]
        turn = np.array([reference.rotation_matrix(r) for r in rotation[:, body]])
        half = turn @ system.contact_segment[arm]
        half *= -np.sign(half[:, 2:] + 1e-12)  # to the lower end
        end = position[:, body] + turn @ system.contact_position[arm] + half
        low = np.flatnonzero(np.abs(end[:, 2] - 0.05) < 0.03)[: -(-worlds // 7)]
        apart = system.contact_radius[pair].sum() - rng.uniform(1e-3, 5e-3, len(low))
        aside = np.sqrt(np.maximum(apart**2 - (end[low, 2] - 0.05) ** 2, 0.0))
        away = half[low, :2] + 1e-6
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        q[low, 7:] = end[low, :2] + aside[:, None] * away
        found.append(q[low])
    q = np.stack(found, axis=1).reshape(-1, system.nq)[:worlds]
    assert len(q) == worlds
    v = rng.normal(size=(worlds, system.nv))
    return q, v, rng.uniform(-1, 1, (worlds, system.nu))


def test_pushing_keeps_momentum() -> None:
    """What the object gets the arm loses; the table, without friction, gives none."""
    system = physics.load_system(PUSHER)
    q, v, u = (x.astype(np.float32) for x in presses(70))
    _, after, impulse, _, fault = map(np.asarray, batched_step(system)(q, v, u))
    assert not fault.any()
    pushed = system.body_names.index("object")
    size = np.abs(impulse[:, pushed, :2]).max(axis=1)
    assert (size > 0).mean() > 0.9
    lost = np.abs(impulse[:, :, :2].sum(axis=1)).max(axis=1)
    gained = np.abs(after[:, 7:] - v[:, 7:] - impulse[:, pushed, :2]).max(axis=1)
    scale = np.maximum(size, 1.0)
    report("momentum lost, of that of a metre a second", (lost / scale).max())
    report("change of the object's momentum beside its impulse", (gained / scale).max())
    assert max((lost / scale).max(), (gained / scale).max()) < 1e-5


def test_task() -> None:
    before, after, actions = rolled("pusher")
    goal = np.array([0.45, 0.05, 0.05])
    q, v = after.pipeline_state.q, after.pipeline_state.v
    (old_hand, old_pushed), (hand, pushed) = (
        [links[name][0][..., :3] for name in ("r_wrist_roll_link", "object")]
        for links in (bodies("pusher", before), bodies("pusher", after))
    )
    aim = np.broadcast_to(goal, hand.shape)
    blocks = [q[..., :7], v[..., :7], hand, pushed, aim]
    agree(after.obs, np.concatenate(blocks, axis=-1))
    # of the state before the step, as in the original
    distance = np.linalg.norm(old_pushed - goal, axis=-1)
    near = np.linalg.norm(old_pushed - old_hand, axis=-1)
    control = np.sum(actions**2, axis=-1)
    expected = {"reward_dist": -distance, "reward_ctrl": -control, "reward_near": -near}
    metrics_are(after, expected)
    agree(after.reward, -distance - 0.1 * control - 0.5 * near, 5.0)
    assert not after.done.any()


def test_reset() -> None:
    env = Pusher()
    keys = jax.random.split(jax.random.key(0), 2000)
    state = jax.jit(jax.vmap(env.reset))(keys).pipeline_state
    q, v = np.asarray(state.q), np.asarray(state.v)
    pose = env.system.rest_q[:7].astype(np.float32)
    np.testing.assert_array_equal(q[:, :7], np.tile(pose, (2000, 1)))
    # of every joint; the original has noise on three
    fastest = np.abs(v[:, :7]).max(axis=0)
    assert (fastest > 0.0049).all() and (fastest <= 0.005).all()
    assert not v[:, 7:].any()
    x, y = q[:, 7:].T
    radius = np.hypot(x, y)
    assert radius.max() == pytest.approx(0.17, abs=1e-6)
    assert (x <= 0).all() and np.abs(np.mean(y)) < 0.01
    # drawn from 0.3 m x 0.4 m; of what was drawn, this share was near enough
    share = 0.5 * np.pi * 0.17**2 / (0.3 * 0.4)
    assert np.mean(radius < 0.17 - 1e-6) == pytest.approx(share, abs=0.03)
    bent = Pusher(reset_noise_scale=0.2, reset_velocity_noise_scale=0.0)
    state = jax.device_get(jax.jit(bent.reset)(jax.random.key(0))).pipeline_state
    assert 0.1 < np.abs(state.q[:7] - pose).max() <= 0.2 and not state.v.any()


def test_the_table_pusher_has_noise_on_velocities() -> None:
    env = TablePusher(reset_noise_scale=0.5)
    v = jax.jit(env.reset)(jax.random.key(0)).pipeline_state.v
    assert 0.1 < np.abs(v[:7]).max() <= 0.5
