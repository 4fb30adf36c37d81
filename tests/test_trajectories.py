"""What a trajectory records, and the frames that its pictures show."""

from __future__ import annotations

import dataclasses
import os
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import newton_qd
from newton_qd.files import temporary_name
from newton_qd.physics import reference
from newton_qd.viewing import Trajectory, camera, joined, record, render
from newton_qd.viewing.camera import pictures, times
from newton_qd.viewing.sight import camera_offset

KEY = jax.random.key(0)


def point(steps: int, worlds: int = 1, **options: Any) -> Trajectory:
    """Points that are pushed for some steps."""
    env = newton_qd.create("pointmaze", auto_reset=False, **options)
    return record(env, jnp.ones((worlds, steps, 2)), KEY)


def test_a_repeated_action_is_one_step() -> None:
    options: Any = {"episode_length": 5, "action_repeat": 2, "auto_reset": False}
    env = newton_qd.create("pointmaze", **options)
    assert record(env, jnp.zeros_like, KEY).steps == 3


def test_a_trajectory_has_the_parameters() -> None:
    env = newton_qd.create("hopper_uni", episode_length=5, auto_reset=False)
    light = env.default_params.replace(gravity=jnp.float32(0.0))
    plan = jnp.zeros((5, 3), np.float32)
    high, low = (record(env, plan, KEY, params=p).q[0, -1, 1] for p in (light, None))
    assert high > low


def test_joined_episodes_have_no_contacts_after_their_end() -> None:
    env = newton_qd.create("ant_uni", episode_length=5, auto_reset=False)
    plan = jnp.zeros((6, 8), np.float32)
    short, long = (record(env, p, KEY, contacts=True) for p in (plan[:3], plan))
    whole = joined([short, long]).contacts
    assert short.contacts is not None and short.contacts.impulse.any()
    assert whole is not None and whole.impulse.shape[1] == 6
    assert not whole.impulse[0, 3:].any()


def test_contacts_of_servos_are_those_of_the_steps() -> None:
    env: Any = newton_qd.create("quadruped_uni", episode_length=8, auto_reset=False)
    plan = jax.random.uniform(KEY, (8, 12), np.float32, -1, 1)
    walk = record(env, plan, KEY, contacts=True)
    found = walk.contacts
    assert found is not None
    feet = [env.system.body_names.index(name) for name in walk.drawing.feet]
    up = [found.impulse[0, :, found.body == foot, 2].sum(axis=0) for foot in feet]
    threshold = 0.01 * env.system.total_mass * 9.81 * env.dt
    assert np.array_equal(np.stack(up, -1) > threshold, walk.feet[0, 1:] > 0)


def test_walls_are_not_the_ground() -> None:
    env: Any = newton_qd.create("antmaze", episode_length=1, auto_reset=False)
    seen = record(env, jnp.zeros((1, 8)), KEY, contacts=True).contacts
    assert seen is not None and not seen.ground.all()
    assert np.array_equal(seen.ground, env.system.contact_obstacle == 0)


def test_a_video_has_the_first_and_the_last_frame() -> None:
    assert times(point(5, episode_length=5), 20.0).tolist() == [0, 1, 2, 3, 4, 5]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """Coordinates of the pictures of a pixel; their brightness is their number."""
    seen: list[np.ndarray] = []

    class Numbered:
        def __init__(self, *options: Any) -> None:
            del options

        def picture(self, q: np.ndarray) -> np.ndarray:
            seen.append(q)
            return np.full((1, 1, 3), len(seen), np.uint8)

    monkeypatch.setattr(camera, "Camera", Numbered)
    return seen


@pytest.mark.parametrize("elevation", [None, 30.0])
def test_a_camera_looks_at_its_aim(elevation: float | None) -> None:
    drawing, aim = point(1).drawing, np.array([1.0, -2.0, 0.5])
    away = camera_offset(drawing, elevation=elevation)
    near = camera_offset(drawing, zoom=2.0, elevation=elevation)
    np.testing.assert_allclose(near, away / 2)
    pose = np.array(camera._pose(aim, away))
    np.testing.assert_allclose(pose[:3], aim + away)
    right, up, back = reference.rotation_matrix(pose[3:]).T
    np.testing.assert_allclose(back, away / np.linalg.norm(away), atol=1e-12)
    assert abs(right[2]) < 1e-12 and up[2] > 0
    if elevation is not None:
        assert np.degrees(np.arcsin(back[2])) == pytest.approx(elevation)


@pytest.mark.usefixtures("drawn")
def test_worlds_fill_a_sheet_row_by_row() -> None:
    walk = point(1, worlds=3, episode_length=1)
    (sheet,) = pictures(walk, np.array([0]), width=1, height=1)
    assert sheet[..., 0].tolist() == [[1, 2], [3, 255]]


def test_a_finished_world_stands_still(drawn: list[np.ndarray]) -> None:
    walk = point(4, worlds=2)
    walk = dataclasses.replace(walk, lengths=np.array([1, 4], np.int32))
    list(pictures(walk, np.array([3]), width=1, height=1))
    assert np.array_equal(drawn, [walk.q[0, 1], walk.q[1, 3]])


def test_a_picture_removes_parts_of_killed_commands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another command, which may be at work, keeps its part."""
    image = np.zeros((4, 4, 3), np.uint8)
    monkeypatch.setattr("newton_qd.viewing.video.pictures", lambda *_, **__: [image])
    target = tmp_path / "one.png"
    old, new = temporary_name(target), temporary_name(target)
    for part, age in ((old, 7200), (new, 60)):
        part.write_bytes(b"half")
        then = time.time() - age
        os.utime(part, (then, then))
    render(point(2), target)
    assert {path.name for path in tmp_path.iterdir()} == {"one.png", new.name}
