"""The maze against its rules, written again in NumPy and in plain branches."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import newton_qd
from newton_qd.envs.pointmaze import PointMaze
from newton_qd.envs.state import State

MAZE = PointMaze()
KEY = jax.random.key(0)
# from, action, to: moves that were read off the original
MOVES = [
    ((0, -0.55), (0, 1), (0, -0.5)),
    ((0, -0.45), (0, -1), (0, -0.49)),
    ((-0.6, -0.55), (0, 1), (-0.6, -0.45)),
    ((-0.5, -0.55), (0, 1), (-0.5, -0.5)),
    ((0, 0.15), (0, 1), (0, 0.2)),
    ((0, 0.25), (0, -1), (0, 0.21)),
    ((0.6, 0.15), (0, 1), (0.6, 0.25)),
    ((0.5, 0.15), (0, 1), (0.5, 0.2)),
    ((0.95, 0), (1, 0), (1, 0)),
]


def at(position: Any, env: PointMaze = MAZE) -> State:
    return env.fixed_state().replace(obs=jnp.asarray(position, env.dtype))


def move(position: Any, action: Any) -> State:
    return MAZE.step(at(position), jnp.asarray(action, np.float32))


def expected_move(old: np.ndarray, action: np.ndarray) -> np.ndarray:
    """One point in float32 with if, as the rules are told."""
    f = np.float32
    y_old = old[1]
    x, y = old + np.clip(action, f(-1), f(1)) / f(10)
    if y_old <= f(-0.5) < y and crossing(old, (x, y), f(-0.5)) >= f(-0.5):
        y = f(-0.5)
    elif y < f(-0.49) <= y_old < f(0.2) and crossing(old, (x, y), f(-0.5)) >= f(-0.5):
        y = f(-0.49)
    if y_old >= f(0.21) > y and crossing(old, (x, y), f(0.2)) <= f(0.5):
        y = f(0.21)
    elif f(-0.5) < y_old <= f(0.2) < y and crossing(old, (x, y), f(0.2)) <= f(0.5):
        y = f(0.2)
    return np.clip(np.array([x, y], f), f(-1), f(1))


def crossing(old: Any, new: Any, height: np.float32) -> np.float32:
    return (height - old[1]) / (new[1] - old[1]) * (new[0] - old[0]) + old[0]


@pytest.mark.parametrize(("start", "action", "end"), MOVES)
def test_moves_of_the_original(start: Any, action: Any, end: Any) -> None:
    reached = move(start, action)
    np.testing.assert_allclose(reached.obs, end, atol=1e-7)
    assert reached.obs.tolist() == reached.info["state_descriptor"].tolist()


def test_rules_everywhere() -> None:
    # starts on a grid that holds both faces of both walls, actions beyond the limits
    faces = np.array([-0.5, -0.49, 0.2, 0.21], np.float32)
    random = np.random.default_rng(0)
    starts = random.uniform(-1, 1, (4000, 2)).astype(np.float32)
    starts[:2000, 1] = random.choice(faces, 2000)
    starts[2000:3000, 1] = random.choice(faces, 1000) + random.uniform(-0.1, 0.1, 1000)
    actions = random.uniform(-1.5, 1.5, (4000, 2)).astype(np.float32)
    actions[::7, 1] = 0.0
    states = jax.vmap(at)(jnp.asarray(starts))
    moved = jax.jit(jax.vmap(MAZE.step))(states, jnp.asarray(actions))
    expected = np.array([expected_move(*row) for row in zip(starts, actions)])  # noqa: B905
    np.testing.assert_allclose(moved.obs, expected, atol=1.2e-7)
    stopped = np.isin(expected[:, 1], faces) & (expected[:, 1] != starts[:, 1])
    assert stopped.sum() > 200
    distance = np.linalg.norm(expected - [-0.5, 0.8], axis=1)
    np.testing.assert_allclose(moved.reward, -distance, rtol=1e-6)


def test_reset_is_at_the_bottom() -> None:
    states = jax.jit(jax.vmap(MAZE.reset))(jax.random.split(KEY, 512))
    x, y = np.asarray(states.obs).T
    assert np.abs(x).max() <= 0.1 and np.abs(x).max() > 0.09
    assert y.min() >= -1 and y.max() <= -0.7 and np.ptp(y) > 0.28
    assert np.all(states.reward == 0) and np.all(states.done == 0)
    assert states.metrics == {} and states.pipeline_state == ()
    # x and y come from the second and the third key, as in the original
    _, x_key, y_key = jax.random.split(KEY, 3)
    first = MAZE.reset(KEY).obs
    assert first[0] == jax.random.uniform(x_key, (), np.float32, -1, 1) / 10
    assert first[1] == jax.random.uniform(y_key, (), np.float32, -1, -0.7)


@pytest.mark.parametrize(
    ("position", "done"),
    [
        ((-0.5, 0.8), 1),
        ((-0.54, 0.84), 1),
        ((-0.46, 0.76), 1),
        ((-0.56, 0.8), 0),
        ((-0.44, 0.8), 0),
        ((-0.5, 0.86), 0),
        ((-0.5, 0.74), 0),
    ],
)
def test_done_in_the_goal_zone(position: Any, done: int) -> None:
    assert float(move(position, (0, 0)).done) == done


def test_actions_are_clipped() -> None:
    np.testing.assert_allclose(move((0, -0.8), (7.0, 1e30)).obs, [0.1, -0.7], rtol=1e-6)


def test_the_farthest_place_is_the_reward_offset() -> None:
    farthest = float(move((1, -1), (0, 0)).reward)
    original = newton_qd.tables.original_reward_offset["pointmaze"]
    np.testing.assert_allclose(farthest, -original, 1e-4)
    assert 0 <= newton_qd.tables.reward_offset["pointmaze"] + farthest < 0.01


@pytest.mark.parametrize(
    ("position", "action"),
    [
        ((-0.5, 0.8), (0.0, 0.0)),  # on the goal
        ((0.0, -0.5), (0.5, 0.0)),  # on a face, without a rise
        ((0.0, -0.5), (0.0, 0.0)),
        ((0.0, 0.2), (0.0, 1.0)),
        ((0.0, -0.49), (0.0, -1.0)),
        ((0.3, 0.0), (0.0, 1e-40)),
        ((1.0, 1.0), (1.0, 1.0)),
    ],
)
def test_gradients_are_finite(position: Any, action: Any) -> None:
    def total(position: jax.Array, action: jax.Array) -> jax.Array:
        state = MAZE.step(MAZE.fixed_state().replace(obs=position), action)
        return state.reward + state.obs.sum() + state.info["state_descriptor"].sum()

    place, force = jnp.asarray(position, np.float32), jnp.asarray(action, np.float32)
    with jax.debug_nans(True):
        found = jax.jit(jax.grad(total, argnums=(0, 1)))(place, force)
    assert np.all(np.isfinite(found))


def test_gradient_reaches_the_goal() -> None:
    def distance(actions: jax.Array) -> jax.Array:
        def body(state: State, action: jax.Array) -> tuple[State, None]:
            return MAZE.step(state, action), None

        return jax.lax.scan(body, at((-0.7, -0.2)), actions)[0].reward

    actions = jnp.zeros((3, 2), np.float32)
    found = np.asarray(jax.jit(jax.grad(distance))(actions))
    direction = np.array([0.2, 1.0]) / np.hypot(0.2, 1.0)
    np.testing.assert_allclose(found, np.tile(direction / 10, (3, 1)), rtol=1e-5)


def test_descriptor_properties_of_both_generations() -> None:
    assert MAZE.name == "pointmaze"
    assert MAZE.state_descriptor_name == "xy_position"
    assert MAZE.state_descriptor_length == MAZE.behavior_descriptor_length == 2
    assert MAZE.descriptors_min_values == [-1, -1]
    assert MAZE.descriptors_max_values == [1, 1]
    assert MAZE.descriptors_names == ["x_pos", "y_pos"]
    for limits in (MAZE.descriptor_limits, MAZE.behavior_descriptor_limits):
        assert np.array_equal(limits, [[-1, -1], [1, 1]])
    np.testing.assert_allclose(MAZE.goal, (-0.5, 0.8))


def test_state_descriptor_follows_the_auto_reset() -> None:
    # the original restores the observation alone
    env = newton_qd.create("pointmaze", episode_length=2)
    first = env.reset(KEY)
    state = first
    for _ in range(2):
        state = env.step(state, jnp.ones(2, np.float32))
    assert float(state.done) == 1.0
    assert state.obs.tolist() == first.obs.tolist()
    assert state.info["state_descriptor"].tolist() == first.obs.tolist()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scale_action_space": 0.0}, r"scale_action_space: got 0.0.*above 0"),
        ({"zone_width": -1.0}, r"zone_width: got -1.0.*above 0"),
        ({"wall_width_ratio": np.nan}, r"wall_width_ratio: got nan.*from 0 to 1"),
        ({"wall_width_ratio": -1.0}, r"wall_width_ratio: got -1.0.*from 0 to 1"),
        ({"x_max": np.inf}, r"x_max: got inf.*finite"),
        ({"x_min": 2.0}, r"x_min, x_max: got \(2.0, 1.0\).*x_min at most 0"),
        ({"x_min": 0.5}, r"x_min, x_max: got \(0.5, 1.0\).*x_min at most 0"),
        ({"x_min": 0.0, "x_max": 0.0}, r"x_min, x_max: .*not both 0"),
        ({"y_min": -0.5}, r"y_min, y_max: got \(-0.5.*below -0.7"),
        ({"upper_wall_height_offset": -0.6}, r"upper_wall_height_offset: got .*-0.6"),
        ({"dtype": "float16"}, r"dtype: got 'float16'.*float32, float64"),
    ],
)
def test_settings_that_make_no_maze(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PointMaze(**settings)


@pytest.mark.parametrize("name", ["x_min", "y_max", "upper_wall_height_offset"])
def test_borders_and_walls_are_numbers(name: str) -> None:
    wrong: Any
    for wrong in ("abc", None, [1]):
        with pytest.raises(TypeError, match=rf"^{name}: got .*; allowed: finite numb"):
            newton_qd.create("pointmaze", **{name: wrong})


def test_a_state_of_another_precision_is_refused(x64: None) -> None:
    state = newton_qd.create("pointmaze").reset(KEY)
    wide = newton_qd.create("pointmaze", dtype="float64")
    with pytest.raises(TypeError, match=r"^state\.obs: got .*float32; allowed: .*64"):
        wide.step(state, jnp.zeros(2))


def test_another_maze() -> None:
    maze = PointMaze(y_max=3.0, zone_height_offset_from_y_max=-1.0, zone_width=0.5)
    np.testing.assert_allclose(maze.goal, (-0.5, 2.0))
    state = maze.step(at((-0.3, 1.9), maze), jnp.zeros(2, np.float32))
    assert float(state.done) == 1.0


@pytest.mark.parametrize(
    ("position", "action", "end"),
    [
        ((0.9, 0.4), (0, -1), (0.9, -0.49)),  # through the gap of the upper wall
        ((-0.9, -0.6), (0, 1), (-0.9, 0.2)),  # through that of the lower one
        ((0, 0.9), (0, -1), (0, 0.21)),
        ((0, -0.9), (0, 1), (0, -0.5)),
        ((0.6, 0.4), (-1, -1), (-0.4, 0.21)),
    ],
)
def test_long_steps_stop_at_the_first_wall(
    position: Any, action: Any, end: Any
) -> None:
    env = PointMaze(scale_action_space=1.0)
    found = env.step(at(position, env), jnp.asarray(action, np.float32)).obs
    np.testing.assert_allclose(found, end, atol=1e-6)
