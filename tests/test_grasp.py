"""Grasp: the hand is the original's, its task reckoned in NumPy, and it can grasp."""

from __future__ import annotations

import itertools
from typing import Any

import jax
import numpy as np
import pytest
from contract import row
from control_tasks import STEPS, WORLDS, agree, bodies, make, metrics_are, moving, play

from newton_qd import physics
from newton_qd.compat import brax_envs
from newton_qd.envs.state import State
from newton_qd.physics import reference
from newton_qd.robots import GRASP

FINGERS = tuple(
    f"finger_{finger}_{part}"
    for finger, parts in (
        (1, ("proximal", "distal", "middle")),
        *((finger, ("proximal", "middle", "distal")) for finger in (2, 3, 4)),
    )
    for part in parts
)
ORDER = ("ground", "object", *FINGERS[:3], "palm", *FINGERS[3:], "target")
# Contact flags that the original adds up; only the first body touches anything.
TIPS = ("finger_1_distal", "finger_3_proximal", "finger_4_proximal", "target")
SIGN = (-1, 1, 1, 1)  # of an angle that bends a finger down
ACROSS = ((0, 1), (0, -1), (-1, 0), (1, 0))  # direction of each finger


def asked(bend: float, curl: float, swing: float, height: float) -> np.ndarray:
    """Action (19,) for angles of all fingers [deg] and a height of the palm [m]."""
    action = []
    for sign in SIGN:
        low = -90.0 if sign < 0 else 0.0
        action += [2 * (sign * x - low) / 90 - 1 for x in (curl, bend)]
        action += [sign * swing / 45, 0.0]
    return np.array([*action, 0.0, 0.0, (height - 3.5) / 5 - 1], np.float32)


def played(stages: list[tuple[int, np.ndarray]]) -> tuple[State, State]:
    """States before and after each step of a world that carries out stages."""
    actions = np.concatenate([np.tile(action, (n, 1, 1)) for n, action in stages])
    keys = jax.random.split(jax.random.key(0), 1)
    state = jax.jit(jax.vmap(make("grasp").reset))(keys)
    return jax.tree.map(np.asarray, play(make("grasp"))(state, actions))


OPEN, CLOSED = (45.0, 30.0, 0.0), (75.0, 75.0, 40.0)
SCRIPT = [
    (40, asked(*OPEN, 3.5)),
    (60, asked(*CLOSED, 3.5)),
    (60, asked(*CLOSED, 8.0)),
    (100, asked(*CLOSED, 8.0)),
]
"""Open, close, lift, and hold for two seconds."""


def unit(way: np.ndarray) -> np.ndarray:
    return way / (1e-6 + np.linalg.norm(way, axis=-1, keepdims=True))


def reckoned(before: State, after: State) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Observation and metrics of steps (t, n), with the targets before they moved."""
    system, links = make("grasp").system, bodies("grasp", after)
    old = before.pipeline_state.q[..., make("grasp")._target]
    shape = old.shape[:-1]
    places, speeds, touching = {}, {}, {}
    for link in ORDER:
        places[link] = speeds[link] = np.zeros((*shape, 3))
        touching[link] = np.zeros(shape)
        if link == "ground":
            continue
        body = system.body_names.index(link)
        offset = np.append(system.com[body], [0, 0, 0, 1])
        rows = links[link][0].reshape(-1, 7)
        found = [reference.compose(row, offset)[:3] for row in rows]
        places[link] = np.array(found).reshape(*shape, 3)
        speeds[link] = links[link][1][..., :3]
        change = after.pipeline_state.impulse[..., body, :3] / system.mass[body]
        touching[link] = 1.0 * (np.sum(change**2, axis=-1) > 1e-5)
    places["target"] = old
    local = {link: places[link] - places["palm"] for link in ORDER}
    there, ahead = local["object"], places["target"] - places["object"]
    hand = speeds["finger_1_proximal"]
    going = np.sum(unit(there) * hand, axis=-1)
    carrying = np.sum(unit(ahead) * speeds["object"], axis=-1)
    blocks = [
        *(np.linalg.norm(there, axis=-1)[..., None], unit(there)),
        *(np.linalg.norm(local["target"], axis=-1)[..., None], unit(local["target"])),
        *(local[link] for link in ORDER),
        *(speeds[link] for link in ORDER),
        *(there, hand, going[..., None]),
        *(np.linalg.norm(ahead, axis=-1)[..., None], unit(ahead), carrying[..., None]),
        np.stack([touching[link] for link in ORDER], axis=-1),
    ]
    metrics = {
        "hits": 1.0 * (np.linalg.norm(ahead, axis=-1) < 1.1),
        "touchingObject": 0.2 * 0.02 * sum(touching[link] for link in TIPS),
        "movingToObject": 0.1 * 0.02 * going,
        "movingObjectToTarget": 1.5 * 0.02 * carrying,
        "closeToObject": 0.1 * 0.02 / (1 + np.linalg.norm(there[..., :2], axis=-1)),
    }
    return np.concatenate(blocks, axis=-1), metrics


def is_the_originals(before: State, after: State) -> dict[str, np.ndarray]:
    """Checks observation, reward, done and metrics of steps; returns the metrics."""
    obs, metrics = reckoned(before, after)
    agree(after.obs, obs, 10.0)
    metrics_are(after, metrics)
    agree(after.reward, sum(metrics.values()) + 4 * metrics["hits"], 5.0)
    assert not after.done.any() and not after.info["fault"].any()
    return metrics


def test_a_scripted_hand_grasps() -> None:
    """It lifts the object by metres, and holds it for two seconds, as it was reckoned.

    The target, which begins near the object, is hit at once and moves away.
    """
    before, after = played(SCRIPT)
    metrics = is_the_originals(before, after)
    object_z = after.pipeline_state.q[:, 0, 2]
    # the palm touches it at the start, as in the original, and presses it down
    assert np.abs(object_z[:40] - 1).max() < 0.03
    assert object_z[-100:].min() > 4.5
    assert np.ptp(object_z[-50:]) < 0.2
    # all four fingers hold it; their friction carries its weight
    names = make("grasp").system.body_names
    tips = [names.index(f"finger_{finger}_distal") for finger in (1, 2, 3, 4)]
    found = after.pipeline_state
    assert found.normal_impulse[-100:, 0][:, tips].min() > 0.02 * 9.8
    impulse = found.impulse[-100:, 0, :, :3]
    weight = impulse[-50:, 0, 2].mean()
    assert weight == pytest.approx(9.8 * 0.02, rel=0.02)
    # what the object gets, the hand gives
    assert np.abs(impulse.sum(axis=1)).max() < 1e-5 * found.normal_impulse.max()
    assert metrics["hits"][0, 0] == 1 and metrics["touchingObject"][-1, 0] > 0
    key = before.info["rng"][0, 0]
    following, *draws = jax.random.split(key, 4)
    np.testing.assert_array_equal(after.info["rng"][0, 0], following)
    radius, turn, height = (float(jax.random.uniform(draw)) for draw in draws)
    radius, turn = 1.1 + 10 * radius, 2 * np.pi * turn
    place = [radius * np.cos(turn), radius * np.sin(turn), 8 * height]
    target = found.q[:, 0, make("grasp")._target]
    agree(target[0], place, 10.0)
    np.testing.assert_array_equal(np.ptp(target[:100], axis=0), np.zeros(3))


def test_task() -> None:
    """Worlds that move at random, some with the object in the hand."""
    env, rng = make("grasp"), np.random.default_rng(0)
    q = np.tile(env.system.rest_q, (WORLDS, 1))
    hinges = [env.joint(f"{link}")[0].start for link, _ in GRASP.actuators[:16]]
    q[:, hinges] += rng.uniform(-0.3, 0.3, (WORLDS, 16))
    q[:4, env._target] = rng.uniform(2, 5, (4, 3))
    v = rng.normal(size=(WORLDS, env.system.nv))
    v[:, [env.joint(f"target_{axis}")[1].start for axis in "xyz"]] = 0
    keys = jax.random.split(jax.random.key(0), WORLDS)
    state = jax.jit(jax.vmap(env.reset))(keys)
    state = state.replace(pipeline_state=moving(env, q, v))
    actions = rng.uniform(-1.3, 1.3, (STEPS, WORLDS, 19)).astype(np.float32)
    before, after = jax.tree.map(np.asarray, play(env)(state, actions))
    metrics = is_the_originals(before, after)
    assert metrics["hits"][0, 4:].all() and not metrics["hits"][0, :4].any()


def test_the_largest_actions_are_no_fault() -> None:
    """Every corner of the palm's range, held, and fingers that switch at random."""
    env, rng, worlds = make("grasp"), np.random.default_rng(0), 27
    actions = rng.choice([-1.0, 1.0], (40, worlds, 19)).astype(np.float32)
    actions[..., 16:] = list(itertools.product((-1, 0, 1), repeat=3))
    keys = jax.random.split(jax.random.key(0), worlds)
    state = jax.jit(jax.vmap(env.reset))(keys)
    _, after = play(env)(state, actions)
    assert not np.any(after.info["fault"])
    assert np.abs(after.pipeline_state.v).max() < 50


def test_reset() -> None:
    """Every key gives the same pose, and the target near the object."""
    env: Any = make("grasp")
    keys = jax.random.split(jax.random.key(0), 3)
    state = jax.jit(jax.vmap(env.reset))(keys)
    rest = np.tile(env.system.rest_q.astype(np.float32), (3, 1))
    np.testing.assert_array_equal(state.pipeline_state.q, rest)
    np.testing.assert_array_equal(state.info["rng"], jax.random.key_data(keys))
    assert not np.any(state.pipeline_state.v)
    # places of the original
    places = {"object": (0, 0, 1), "palm": (0, 0, 3.31066), "target": (0, 0, 1.1)}
    for finger, (x, y) in enumerate(ACROSS, 1):
        for part, radius, z in (
            ("proximal", 2.25, 2.81066),
            ("middle", 3.53033, 2.28033),
            ("distal", 4.06066, 1.0),
        ):
            places[f"finger_{finger}_{part}"] = (x * radius, y * radius, z)
    seen = jax.jit(env.kinematics)(row(state.pipeline_state, 0))
    centres = np.asarray(seen.com)
    for link, place in places.items():
        agree(centres[env.system.body_names.index(link)], place)
    viewed: Any = brax_envs.create("grasp")
    positions = np.asarray(jax.jit(lambda key: viewed.reset(key).qp.pos)(keys[0]))
    for name, link in (
        ("Object", "object"),
        ("HandPalm", "palm"),
        ("HandThumbDistal", "finger_1_distal"),
        ("HandThumbMiddleThree", "finger_3_middle"),
        ("Target", "target"),
    ):
        agree(positions[viewed.sys.body.index[name]], places[link])


def test_the_hand_is_the_originals() -> None:
    system = physics.load_system(GRASP)
    for link in ("object", *FINGERS):
        body = system.body_names.index(link)
        assert system.mass[body] == 1.0
        np.testing.assert_array_equal(system.inertia[body], np.eye(3))
    names = [joint for joint, _ in GRASP.actuators]
    dofs = system.v_start[[system.joint_names.index(joint) for joint in names]]
    low, high = (
        np.degrees(limit[dofs[:16]])
        for limit in (system.limit_lower, system.limit_upper)
    )
    bends = np.array([(-90, -90), *[(0, 0)] * 3])
    swings = np.full((4, 2), -45)
    np.testing.assert_allclose(low.reshape(4, 4), np.hstack([bends, swings]))
    np.testing.assert_allclose(high.reshape(4, 4), np.hstack([bends + 90, -swings]))
    np.testing.assert_array_equal(system.gear[:16], np.full(16, 300.0))
    np.testing.assert_array_equal(system.damping[dofs[:16]], np.full(16, 50.0))
    assert (GRASP.dt, GRASP.substeps, GRASP.gravity) == (0.02, 4, 9.8)
    radius = dict(zip(system.contact_body, system.contact_radius, strict=True))
    for link, expected in (("object", 1.0), ("palm", 1.5), ("finger_2_distal", 0.5)):
        assert radius[system.body_names.index(link)] == expected
    assert len(system.contact_pairs) == 5 and len(system.ground_contacts) == 2


def test_the_palm_goes_as_in_the_original() -> None:
    """15 % of the way in a step, and at most 0.3 m; the hand's inertia delays it."""
    action = asked(*OPEN, 13.5)
    action[16:18] = 0.3, -0.2
    _, after = played([(100, action)])
    found = after.pipeline_state.q[:, 0, make("grasp")._palm]
    place = np.array([0, 0, 3.3106601717798213])
    target, expected = np.array([3.0, -2.0, 13.5]), []
    for _ in range(100):
        way = target - place
        place = place + 0.15 * way * min(1, 2 / np.linalg.norm(way))
        expected.append(place)
    # at 15 m/s, less than a step behind
    assert np.abs(found - expected).max() < 0.25
    np.testing.assert_allclose(found[-1], target, atol=0.02)
