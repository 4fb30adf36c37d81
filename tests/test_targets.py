"""Robots that go to targets: tasks reckoned in NumPy, and where targets go."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import jax
import numpy as np
import pytest
from contract import row, same
from control_tasks import (
    STEPS,
    WORLDS,
    agree,
    bodies,
    make,
    metrics_are,
    moving,
    play,
    thrown,
)

import newton_qd
from newton_qd import physics
from newton_qd.assets import find_urdf
from newton_qd.compat import brax_envs
from newton_qd.envs.state import State
from newton_qd.physics import reference
from newton_qd.physics.model import RobotDescriptionError, build_system
from newton_qd.physics.model.description import read_description
from newton_qd.robots import FETCH
from newton_qd.scenes import TRAP

ARM = tuple(f"{name}_link" for name in ("shoulder", "upper_arm", "forearm"))
WRISTS = tuple(f"wrist_{number}_link" for number in (1, 2, 3))
LEGS = tuple(
    f"{end}_{side}_{half}"
    for end in ("front", "back")
    for side in ("right", "left")
    for half in ("upper", "lower")
)
TORSO = {"ur5e": "wrist_3_link", "fetch": "torso"}
RADIUS = {"ur5e": 0.02, "fetch": 2.0}
SPREAD = {"ur5e": 0.5, "fetch": 15.0}
ORDER = {
    "ur5e": ("ground", *ARM, *WRISTS, "target"),
    "fetch": ("torso", "shoulders", "hips", *LEGS, "ground", "target"),
}
NAMES = tuple(TORSO)
# The dog has the contacts too; one robot, so that one kernel is compiled.
STEPPED = [pytest.param("ur5e", marks=pytest.mark.slow), "fetch"]


def next_place(name: str, data: Any) -> tuple[Any, np.ndarray]:
    """Data of the next key, and the place drawn, as the original computes them."""
    rng, near, turn = jax.random.split(data, 3)
    distance = RADIUS[name] + SPREAD[name] * float(jax.random.uniform(near))
    angle = 2 * np.pi * float(jax.random.uniform(turn))
    return rng, distance * np.array([np.cos(angle), np.sin(angle)])


def near_targets(name: str) -> State:
    """Random worlds, of which the first four are about to reach their target."""
    env = make(name)
    state, _ = thrown(env)
    physics = state.pipeline_state
    q, v = np.array(physics.q), np.array(physics.v)
    if name == "ur5e":
        # the arm leans forward until the hand is at the height of targets
        lean = np.arccos((0.5 - 0.163) / 0.917)
        q[:4] = (0, lean, 0, 0, 0, 0, 0.917 * np.sin(lean), 0.147)
    else:
        q[:] = np.tile(env.system.rest_q, (len(q), 1))
        q[:, 7:-2] += np.random.default_rng(2).uniform(-0.5, 0.5, (len(q), 10))
        q[:4, -2:] = [(1.5, 0), (0, 1.5), (-1, 0), (1, -1)]
    v[:4] = 0
    v[:, env.system.v_start[list(env._links)]] = 0
    return state.replace(pipeline_state=moving(env, q, v))


def expected_observation(name: str, state: State) -> np.ndarray:
    """From the bodies of states (t, n), with their targets."""
    system, links = make(name).system, bodies(name, state)
    frame = links[TORSO[name]][0]
    shape = frame.shape[:2]
    turn = np.array(
        [reference.rotation_matrix(row[3:]) for row in frame.reshape(-1, 7)]
    ).reshape(*shape, 3, 3)
    zeros = np.zeros((*shape, 3))
    places, speeds, touching = [], [], []
    for link in ORDER[name]:
        where, twist, hit = zeros, zeros, zeros[..., 0]
        if link != "ground":
            body = system.body_names.index(link)
            where, twist = centre(name, links[link][0], link), links[link][1][..., :3]
            change = state.pipeline_state.impulse[..., body, :3] / system.mass[body]
            hit = np.sum(change**2, axis=-1) > 1e-5
        places.append(where)
        speeds.append(twist)
        touching.append(hit)
    torso = centre(name, frame, TORSO[name])
    local = [np.einsum("...ji,...j->...i", turn, place - torso) for place in places]
    speed = [np.einsum("...ji,...j->...i", turn, speed) for speed in speeds]
    aim = local[ORDER[name].index("target")]
    distance = np.linalg.norm(aim, axis=-1, keepdims=True)
    blocks = [turn[..., 0], turn[..., 2], distance, aim / (1e-6 + distance)]
    return np.concatenate([*blocks, *local, *speed, np.stack(touching, -1)], axis=-1)


def centre(name: str, frame: np.ndarray, link: str) -> np.ndarray:
    """Centre of mass (t, n, 3) of a link with frames (t, n, 7)."""
    system = make(name).system
    offset = np.append(system.com[system.body_names.index(link)], [0, 0, 0, 1])
    rows = [reference.compose(row, offset)[:3] for row in frame.reshape(-1, 7)]
    return np.array(rows).reshape(*frame.shape[:-1], 3)


def with_target(state: State, slides: np.ndarray, place: np.ndarray) -> State:
    """States with the target elsewhere."""
    q = np.array(state.pipeline_state.q)
    q[..., slides] = place
    return state.replace(pipeline_state=dataclasses.replace(state.pipeline_state, q=q))


@pytest.mark.parametrize("name", STEPPED)
def test_task(name: str) -> None:
    """Observation and reward are those of the old place, also in the step of a hit."""
    env = make(name)
    slides = env._target
    state, (_, actions) = near_targets(name), thrown(env)
    if name == "ur5e":
        actions[:, :4] = 0
    before, after = jax.tree.map(np.asarray, play(env)(state, actions))
    old = before.pipeline_state.q[..., slides]
    seen = with_target(after, slides, old)
    agree(after.obs, expected_observation(name, seen), 10.0)
    start, end = (
        centre(name, bodies(name, s)[TORSO[name]][0], TORSO[name])
        for s in (before, after)
    )
    away = centre(name, bodies(name, seen)["target"][0], "target") - end
    distance = np.linalg.norm(away, axis=-1)
    aim = away / (1e-6 + distance)[..., None]
    hit = (distance < RADIUS[name]).astype(float)
    assert hit[0, :4].all() and hit.mean() < 0.5
    going = 0.1 * np.sum((end - start) * aim, axis=-1)
    expected = {"hits": hit, "weightedHits": hit, "movingToTarget": going}
    if name == "fetch":
        frame = bodies(name, after)["torso"][0]
        turn = [reference.rotation_matrix(row[3:]) for row in frame.reshape(-1, 7)]
        axes = np.array(turn).reshape(*hit.shape, 3, 3)
        expected["weightedHits"] = hit * np.sum(aim * axes[..., 0], axis=-1)
        expected["torsoIsUp"] = 0.002 * axes[..., 2, 2]
        expected["torsoHeight"] = 0.002 * end[..., 2]
        assert 0.9 < expected["weightedHits"][0, 0] and after.obs[0, :, -13:-2].any()
        assert not after.obs[0, :, -2:].any()
    metrics_are(after, expected)
    agree(after.reward, sum(expected.values()) - expected["hits"])
    assert not after.done.any()
    for step, world in ((0, 0), (0, 1), (0, 7), (2, 3)):
        data, place = next_place(name, before.info["rng"][step, world])
        np.testing.assert_array_equal(after.info["rng"][step, world], data)
        if not hit[step, world]:
            place = old[step, world]
        agree(after.pipeline_state.q[step, world][slides], place, RADIUS[name])
    # the reported bodies, which the next step reads, have the new place
    links = bodies(name, after)
    for body, link in enumerate(env.system.body_names):
        found = after.pipeline_state.bodies.position[..., body, :]
        agree(found, links[link][0][..., :3], 10.0)


@pytest.mark.parametrize("name", NAMES)
def test_reset(name: str) -> None:
    """The pose is always the same; the place is that of the original for a key."""
    env: Any = make(name)
    keys = jax.random.split(jax.random.key(0), 1000)
    state = jax.jit(jax.vmap(env.reset))(keys)
    q, slides = np.asarray(state.pipeline_state.q), env._target
    rest = np.delete(env.system.rest_q.astype(np.float32), slides)
    np.testing.assert_array_equal(
        np.delete(q, slides, axis=1), np.tile(rest, (1000, 1))
    )
    assert not np.any(state.pipeline_state.v)
    radius = np.linalg.norm(q[:, slides], axis=1) - RADIUS[name]
    assert 0 <= radius.min() and radius.max() <= SPREAD[name]
    assert np.mean(radius) == pytest.approx(SPREAD[name] / 2, rel=0.05)
    for world in range(3):
        data, place = next_place(name, jax.random.key_data(keys[world]))
        np.testing.assert_array_equal(state.info["rng"][world], data)
        agree(q[world, slides], place, RADIUS[name])
    viewed: Any = brax_envs.create(name)
    body = viewed.sys.body.index["Target"]
    found = jax.jit(lambda key: viewed.reset(key).qp.pos)(keys[0])
    agree(found[body, :2], q[0, slides], RADIUS[name])
    # old keys, and keys of other generators
    reset = jax.jit(env.reset)
    raw = reset(jax.random.key_data(keys[0]))
    assert same(raw.info, row(state.info, 0))
    other = reset(jax.random.key(0, impl="rbg"))
    assert other.info["rng"].shape == (4,)


def test_keys_of_other_generators_go_on() -> None:
    env = make("fetch")
    key = jax.random.key(0, impl="rbg")
    state = jax.jit(env.reset)(key)
    after = jax.jit(env.step)(state, np.zeros(10, np.float32))
    for found in (state, after):
        key, _ = next_place("fetch", key)
        assert same(found.info["rng"], jax.random.key_data(key))


def test_targets_go_on_after_an_auto_reset() -> None:
    """Back to the first place, as in the original; the next ones are new."""
    env = newton_qd.create("fetch", episode_length=2, batch_size=2)
    first = jax.jit(env.reset)(jax.random.key(0))
    assert not same(first.obs[0], first.obs[1])
    step, state, action = jax.jit(env.step), first, np.zeros((2, 10), np.float32)
    keys = [np.asarray(first.info["rng"])]
    for _ in range(2):
        state = step(state, action)
        keys.append(np.asarray(state.info["rng"]))
    assert same(state.pipeline_state, first.pipeline_state)
    assert len(np.unique(np.concatenate(keys), axis=0)) == 6


def test_the_dog_is_the_originals() -> None:
    """Numbers are in the original's terms: of a box, half the size."""
    system = physics.load_system(FETCH)
    frames = reference.body_frames(system, system.rest_q)
    files = read_description(find_urdf(FETCH.urdf)).bodies
    places: dict[str, tuple[float, ...]] = {
        "torso": (0, 0, 1.375),
        "shoulders": (1, 0, 1.375),
        "hips": (-1, 0, 1.375),
    }
    sizes = {"torso": (0.75, 0.25, 0.125)}
    sizes |= dict.fromkeys(("shoulders", "hips"), (0.25, 0.75, 0.125))
    for leg in LEGS:
        x, y = 1 if "front" in leg else -1, 1 if "left" in leg else -1
        low = leg.endswith("lower")
        places[leg] = (x, y * (0.625 if low else 0.875), 0.5 if low else 1.0)
        sizes[leg] = (0.25, 0.125, 0.5)
    for link, place in places.items():
        body = system.body_names.index(link)
        assert system.mass[body] == 1.0
        np.testing.assert_array_equal(system.inertia[body], np.eye(3))
        middle = reference.compose(frames[body], np.append(system.com[body], [0] * 4))
        np.testing.assert_allclose(middle[:3], place, atol=1e-12)
        (shape,) = files[link].shapes
        assert shape.kind == "box"
        np.testing.assert_allclose(shape.size, sizes[link], atol=1e-12)
        np.testing.assert_allclose(shape.frame[:3], system.com[body], atol=1e-12)
    hinges = [system.joint_names.index(joint) for joint, _ in FETCH.actuators]
    assert [system.body_names[body] for body in hinges] == ["shoulders", "hips", *LEGS]
    axes = [(1, 0, 0)] * 2 + [(0, 1, 0)] * 8
    np.testing.assert_array_equal(system.joint_axis[hinges], axes)
    np.testing.assert_array_equal(system.gear, np.full(10, 300.0))
    dofs = system.v_start[hinges]
    np.testing.assert_allclose(np.degrees(system.limit_upper[dofs]), np.full(10, 60.0))
    np.testing.assert_array_equal(system.limit_lower, -system.limit_upper)
    np.testing.assert_array_equal(system.damping[dofs], np.full(10, 35.0))
    assert (FETCH.dt, FETCH.gravity, FETCH.material.friction) == (0.02, 9.8, 0.6)


def test_boxes_touch_with_their_corners() -> None:
    """The lowest corner of four turned boxes, by hand."""
    system = physics.load_system(FETCH)
    assert len(system.contact_body) == len(system.ground_contacts) == 32
    assert not system.contact_radius.any()
    q = np.array(system.rest_q)
    pitch, roll = 0.3, 0.2
    q[3:7] = reference.rpy_quaternion(roll, pitch, 0.0)
    # heights of the offsets from the torso's origin, whose height is 1.375
    up = reference.rotation_matrix(q[3:7])[2]
    corners = itertools.product((1.25, 0.75, -0.75, -1.25), (0.5, 0.75, -0.5, -0.75))
    heights = [up @ (x, y, z) for x, y in corners for z in (-1.375, -0.375)]
    lowest = reference.lowest_contact(system, q)
    assert lowest == pytest.approx(1.375 + min(heights), abs=1e-12)
    with pytest.raises(RobotDescriptionError, match=r"got box; allowed: .* of sphere"):
        build_system(FETCH, "float32", TRAP)


def test_the_dog_stands() -> None:
    """The ground carries its weight with all feet, on the lower corners."""
    env = make("fetch")
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), WORLDS))
    still = np.zeros((STEPS, WORLDS, 10), np.float32)
    for _ in range(20):
        path = play(env)(state, still)[1]
        state = row(path, -1)
    found = state.pipeline_state
    weight = 11 * 9.8 * 0.02
    np.testing.assert_allclose(found.normal_impulse.sum(axis=1), weight, rtol=1e-3)
    assert np.all(found.feet_contact == 1)
    assert np.abs(found.q[:, 2] - 1.375).max() < 0.003
    assert np.abs(found.v).max() < 1e-3
