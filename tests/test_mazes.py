"""Mazes and hurdles of boxes: their files, their tasks, and what they hold."""

from __future__ import annotations

import importlib.util
import itertools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics_helpers import beside_a_wall, passive, report, rollout
from test_walls import ball_spec

import newton_qd
from newton_qd import physics
from newton_qd.assets import find_urdf
from newton_qd.envs.ant import Ant
from newton_qd.physics.model.scene import read_scene
from newton_qd.physics.system import ObstacleKind, System
from newton_qd.robots import WALKER2D
from newton_qd.scenes import ANTMAZE_HARDEST, HURDLES, SCENES, TRAP
from newton_qd.wrappers import MazeWrapper

_PATH = Path(__file__).resolve().parents[1] / "docs" / "mazes.py"
_SPEC = importlib.util.spec_from_file_location("mazes", _PATH)
assert _SPEC is not None and _SPEC.loader is not None
layouts: Any = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(layouts)


def depth(system: System, points: np.ndarray) -> np.ndarray:
    """How deep points (n, 3) are in a box, negative outside [m]."""
    middle, half = system.obstacle_frame[1:, :3], system.obstacle_size[1:]
    return (half - np.abs(points[:, None] - middle)).min(axis=2).max(axis=1)


def points_of(maze: Any, marks: str) -> np.ndarray:
    """Points (n, 3) all over the cells with one of the marks, 1 m over the ground."""
    first = np.argwhere([[m == "S" for m in row] for row in maze.layout])[0]
    cells = np.argwhere([[m in marks for m in row] for row in maze.layout])
    edge = np.array(list(itertools.product([-0.49, 0.0, 0.49], repeat=2)))
    xy = maze.cell * (cells - first + edge[:, None]).reshape(-1, 2)
    return np.concatenate([xy, np.ones((len(xy), 1))], axis=1)


@pytest.mark.parametrize("name", layouts.MAZES)
def test_walls_are_those_of_the_layout(name: str) -> None:
    maze, links = layouts.MAZES[name], read_scene(SCENES[name])
    written = find_urdf(f"{name}.urdf").read_text(encoding="utf-8")
    assert written == maze.text(name), "run: python docs/mazes.py"
    env: Any = newton_qd.create(name)
    system = env.unwrapped.system
    assert set(system.obstacle_kind[1:]) == {ObstacleKind.BOX}
    assert [link.name for link in links] == ["maze", "target"]
    assert depth(system, points_of(maze, ".ST")).max() < 0
    low, high = (np.asarray(limit) for limit in env.state_descriptor_limits)
    wall = points_of(maze, "#")
    within = ((wall[:, :2] > low - 1) & (wall[:, :2] < high + 1)).all(axis=1)
    assert depth(system, wall[within]).min() > 0
    free = points_of(maze, ".ST")[:, :2]
    near = 0.01 * maze.cell
    np.testing.assert_allclose([free.min(0) - near, free.max(0) + near], [low, high])
    target = system.scene_frames[1]
    assert (depth(system, target[None, :3]) < 0).all()


def test_hurdles() -> None:
    system = physics.load_system(WALKER2D, scene=HURDLES)
    middle, half = system.obstacle_frame[1:], system.obstacle_size[1:]
    np.testing.assert_allclose(middle[:, 0], [3, 6, 9, 12, 15])
    top = middle[:, 2] + half[:, 2]
    np.testing.assert_allclose(top, [0.1, 0.15, 0.2, 0.25, 0.3])
    assert np.all(half[:, :2] == [0.2, 1.0])


@pytest.mark.slow
def test_no_shot_gets_into_a_wall(tmp_path: Path) -> None:
    """A ball from the middle of every free cell in all directions, up to 10 m/s."""
    system = physics.load_system(ball_spec(tmp_path), "float32", ANTMAZE_HARDEST)
    middles = points_of(layouts.MAZES["antmaze_hardest"], ".ST").reshape(9, -1, 3)[4]
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False) + 0.1
    way = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    start, way, speed = (
        np.array(x)
        for x in zip(*itertools.product(middles, way, [5.0, 10.0]), strict=True)
    )
    q, v = np.zeros((len(start), 7)), np.zeros((len(start), 6))
    q[:, :2], q[:, 2], q[:, 6] = start[:, :2], 0.25, 1.0
    v[:, :3] = speed[:, None] * way
    run = jax.vmap(lambda q, v: rollout(system)(q, v, passive(system, 100)))
    path = run(q.astype(np.float32), v.astype(np.float32))
    position = np.asarray(path.q, np.float64)[..., :3]
    hit = (np.abs(np.asarray(path.impulse))[..., :2].max(axis=(1, 2, 3)) > 5.0).mean()
    deepest = depth(system, position.reshape(-1, 3)).max()
    report("balls, share that hit, centre in a wall [m]", (len(q), hit, deepest))
    assert deepest < -0.1
    assert hit > 0.7


STEPS = 1000
SETTLED = 100  # steps until who starts in a wall is out of it


@pytest.mark.slow
@pytest.mark.parametrize("name", ["antmaze_u", "humanoid_maze", "walker2d_trap"])
def test_random_steps_beside_walls(name: str) -> None:
    """1,000 of them are finite, and nothing gets through."""
    env: Any = newton_qd.create(name, auto_reset=False, episode_length=None)
    system, rng = env.unwrapped.system, np.random.default_rng(0)
    q = beside_a_wall(system, np.tile(system.rest_q, (8, 1)), rng)
    first = env.reset(jax.random.key(0))

    def run(q: jax.Array, key: jax.Array) -> tuple[jax.Array, ...]:
        def advance(state: Any, key: jax.Array) -> tuple[Any, tuple[jax.Array, ...]]:
            action = jax.random.choice(key, jnp.array([-1, 1], env.dtype), (system.nu,))
            state = env.step(state, action)
            physical = state.pipeline_state
            read = state.obs, state.reward, state.info["state_descriptor"]
            return state, (*read, state.info["fault"], physical.q, physical.impulse)

        pose = physics.initial_state(system, q, jnp.zeros(system.nv, env.dtype))
        state = first.replace(pipeline_state=pose)
        return jax.lax.scan(advance, state, jax.random.split(key, STEPS))[1]

    keys = jax.random.split(jax.random.key(1), 8)
    found = jax.jit(jax.vmap(run))(q.astype(np.float32), keys)
    *read, fault, q, impulse = (np.asarray(x) for x in found)
    assert all(np.isfinite(x).all() for x in read)
    assert not fault.any()
    assert (np.abs(impulse[..., 0]).max(axis=(1, 2)) > 0).all()
    walls = system.contact_obstacle > 0
    measure = jax.jit(jax.vmap(jax.vmap(lambda q: physics.contact_gaps(system, q))))
    gaps = np.asarray(measure(q))[..., walls].min(axis=2)
    touched = (gaps < 0).any(axis=1).mean()
    deepest = -gaps[:, SETTLED:].min()
    report(f"{name}: share that touches, deepest in a wall [m]", (touched, deepest))
    assert touched > 0.4
    # the hurdles are 0.2 m, and the links 0.04 m, from their middle to their surface
    assert deepest < 0.08


def test_mazes_of_others(tmp_path: Path) -> None:
    """A wrapper by hand keeps its options around other wrappers."""
    options: Any = {"scene": ANTMAZE_HARDEST, "area": ((-2, -2), (26, 38))}
    env: Any = MazeWrapper(newton_qd.create("ant"), "ant", heights=(0.5, 1), **options)
    state = jax.eval_shape(env.reset, jax.random.key(0))
    assert state.obs.shape == (env.observation_size,) == (101,)
    inside = env.env.env.env
    assert (inside.scene, inside.heights) == (ANTMAZE_HARDEST, (0.5, 1))
    wrongs: list[tuple[dict[str, Any], type[Exception], str]] = [
        ({"scene": "maze"}, TypeError, "scene: got 'maze'; allowed: None, or a newt"),
        ({"scene": TRAP}, ValueError, "scene: got 'trap' with trap; allowed: .*target"),
        ({"area": ((0, 0), (0, 1))}, ValueError, r"area: got .*; allowed: lowest and"),
        ({"area": 3}, ValueError, "area: got 3; allowed: lowest and"),
        ({"heights": (1, 0)}, ValueError, r"heights: got \(1, 0\); allowed: two num"),
    ]
    for wrong, error, message in wrongs:
        with pytest.raises(error, match=f"^{message}"):
            MazeWrapper(Ant(), "ant", **wrong)


def test_another_scene_has_another_target() -> None:
    env: Any = newton_qd.create("antmaze_u", episode_length=5)
    moved: Any = env.with_scene(ANTMAZE_HARDEST)
    links = moved.system.scene_links
    target = moved.system.scene_frames[links.index("target"), :2]
    state = jax.device_get(jax.jit(moved.fixed_state)())
    place = state.pipeline_state.q[:2]
    assert state.reward == pytest.approx(-np.linalg.norm(place - target))
    with pytest.raises(ValueError, match=r"scene: got None with .*a link 'target'"):
        env.with_scene(None)
