"""Trap and maze as tasks, reckoned again in NumPy, and scenes under any wrappers."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contract import reset, step

import newton_qd
from newton_qd.envs.ant import Ant
from newton_qd.envs.base import Env
from newton_qd.envs.pointmaze import PointMaze
from newton_qd.envs.state import State
from newton_qd.scenes import MAZE, TRAP
from newton_qd.wrappers import (
    AutoResetWrapper,
    EpisodeWrapper,
    FixedInitialStateWrapper,
    MazeWrapper,
    TrapWrapper,
    VectorWrapper,
    Wrapper,
)

KEY = jax.random.key(0)
TASKS = {"trap": TrapWrapper, "maze": MazeWrapper}
ROWS = {"trap": 11, "maze": 12}  # of the contact block: bodies, ground and walls
CENTRE = {"trap": [15, 0], "maze": [17.5, 17.5]}
SCALE = {"trap": [15, 8], "maze": [22.5, 22.5]}
TARGET = np.array([35.0, 0.0])


@functools.cache
def lone_ant() -> Ant:
    """The ant outside of scenes."""
    return Ant()


@functools.cache
def in_scene(task: str) -> Any:
    """The ant in the scene of a task."""
    return TASKS[task](lone_ant(), "ant")


def action_of(env: Env, size: float = 0.0) -> Any:
    return np.full((env.action_size,), size, env.dtype)


def displaced(state: State, start: int, values: list[float]) -> State:
    """A state with other coordinates, from one of them on."""
    physics: Any = state.pipeline_state
    q = np.array(physics.q)
    q[start : start + len(values)] = values
    return state.replace(pipeline_state=dataclasses.replace(physics, q=jnp.asarray(q)))


def placed(env: Env, position: list[float]) -> State:
    """A state of the reset with the torso elsewhere."""
    return displaced(reset(env)(KEY), 0, position)


@pytest.mark.parametrize("task", TASKS)
def test_observation_has_the_same_bits_in_every_program(task: str) -> None:
    env = in_scene(task)
    keys = jax.random.split(KEY, 8)
    starts = jnp.linspace(0.1, 7.3, 8, dtype=env.dtype)

    def begin(key: jax.Array, x: jax.Array) -> State:
        state = env.reset(key)
        physics: Any = state.pipeline_state
        q = physics.q.at[:2].set(x)
        return state.replace(pipeline_state=dataclasses.replace(physics, q=q))

    def after(state: State) -> jax.Array:
        return env.step(state, action_of(env, 0.3)).obs

    def seen(key: jax.Array, x: jax.Array) -> jax.Array:
        return after(begin(key, x))

    batch = np.asarray(jax.jit(jax.vmap(seen))(keys, starts))
    one_by_one = jax.jit(lambda *x: jax.lax.map(lambda y: seen(*y), x))(keys, starts)
    assert np.array_equal(batch, one_by_one)
    # without jit, each operation is a program
    begin = jax.jit(begin)
    for i in (0, 3):
        assert np.array_equal(batch[i], after(begin(keys[i], starts[i])))


@pytest.mark.parametrize("task", TASKS)
def test_observation(task: str) -> None:
    """Scaled position, then the ant's, then contact rows of the walls too."""
    env, ant = in_scene(task), lone_ant()
    rows = ROWS[task]
    assert env.observation_size == 2 + 27 + 6 * rows
    assert sum(size for _, size in env.observation_layout) == env.observation_size
    around = TASKS[task](EpisodeWrapper(Ant(), 5, 1), "ant")
    assert around.observation_layout == env.observation_layout
    start = placed(env, [3.0, -1.5, 0.6])
    after = step(env)(start, action_of(env, 0.3))
    plain = step(ant)(placed(ant, [3.0, -1.5, 0.6]), action_of(ant, 0.3))
    obs, expected = np.asarray(after.obs), np.asarray(plain.obs)
    xy = np.asarray(after.pipeline_state.q[:2])
    place = (xy - CENTRE[task]) / np.array(SCALE[task])
    np.testing.assert_allclose(obs[:2], place, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(obs[2:29], expected[:27])
    linear, angular = np.split(obs[29:], 2)
    assert linear.shape == (3 * rows,)
    np.testing.assert_array_equal(linear[:27], expected[27:54])
    np.testing.assert_array_equal(angular[:27], expected[57:84])
    assert not linear[27:].any() and not angular[27:].any()


def test_position_is_not_clipped() -> None:
    env = in_scene("trap")
    after = step(env)(placed(env, [60.0, 40.0, 0.6]), action_of(env))
    np.testing.assert_allclose(after.obs[:2], [3.0, 5.0], atol=0.01)


def test_trap_keeps_reward_and_end() -> None:
    env, ant = in_scene("trap"), lone_ant()
    for height in (0.6, 1.5):
        ours = step(env)(placed(env, [3.0, 0.0, height]), action_of(env, 0.5))
        theirs = step(ant)(placed(ant, [3.0, 0.0, height]), action_of(ant, 0.5))
        assert float(ours.reward) == float(theirs.reward)
        assert float(ours.done) == float(theirs.done) == float(height > 1)
        assert set(ours.metrics) == set(theirs.metrics)


def test_trap_walls_are_there() -> None:
    """An ant at rest against the back wall is pushed back; the plain ant is not."""
    env, ant = in_scene("trap"), lone_ant()
    pushed = step(env)(placed(env, [10.9, 0.0, 0.6]), action_of(env))
    free = step(ant)(placed(ant, [10.9, 0.0, 0.6]), action_of(ant))
    assert float(pushed.pipeline_state.v[0]) < -0.1
    assert abs(float(free.pipeline_state.v[0])) < 0.02


def test_maze_reward() -> None:
    env = in_scene("maze")
    first = reset(env)(KEY)
    assert float(first.reward) == pytest.approx(-35.0)
    assert float(first.done) == 0
    for position in ([3.0, -1.5, 0.6], [34.0, 1.0, 0.6], [35.0, 0.0, 0.6]):
        after = step(env)(placed(env, position), action_of(env, 0.2))
        xy = np.asarray(after.pipeline_state.q[:2], np.float64)
        expected = -np.linalg.norm(xy - TARGET)
        assert float(after.reward) == pytest.approx(expected, rel=1e-5, abs=1e-6)
        assert float(after.done) == 0
        assert float(after.metrics["reward_survive"]) == 1


@pytest.mark.parametrize(
    ("height", "done"), [(0.3, 1), (0.6, 0), (1.5, 0), (4.9, 0), (5.3, 1)]
)
def test_maze_end(height: float, done: int) -> None:
    env = in_scene("maze")
    state = placed(env, [3.0, 0.0, height])
    if height < 0.5:  # it falls on its back
        state = displaced(state, 3, [1.0, 0.0, 0.0, 0.0])
        v = np.array(state.pipeline_state.v)
        v[2] = -10.0
        moving = dataclasses.replace(state.pipeline_state, v=jnp.asarray(v))
        state = state.replace(pipeline_state=moving)
    after = step(env)(state, action_of(env))
    reached = float(after.pipeline_state.q[2])
    assert (reached < 0.2 or reached > 5.0) == bool(done)
    assert float(after.done) == done


def test_maze_reward_has_a_gradient_at_the_target() -> None:
    env = in_scene("maze")

    def reward(xy: jax.Array) -> jax.Array:
        state = env.reset(KEY)
        q = state.pipeline_state.q.at[:2].set(xy)
        physics = dataclasses.replace(state.pipeline_state, q=q)
        return env.step(state.replace(pipeline_state=physics), action_of(env)).reward

    gradient = jax.jit(jax.grad(reward))
    assert np.isfinite(gradient(jnp.asarray(TARGET, np.float32))).all()
    slope = gradient(jnp.array([3.0, 0.0], np.float32))
    np.testing.assert_allclose(slope, [1.0, 0.0], atol=0.01)


@pytest.mark.parametrize("task", TASKS)
def test_fault_is_contained(task: str) -> None:
    env = in_scene(task)
    after = step(env)(reset(env)(KEY), action_of(env, np.nan))
    assert int(after.info["fault"]) == 1
    assert float(after.reward) == 0 and float(after.done) == 1
    assert np.isfinite(after.obs).all()


@pytest.mark.parametrize("task", TASKS)
def test_the_argument_stays_as_it_is(task: str) -> None:
    ant = Ant()
    chain = AutoResetWrapper(EpisodeWrapper(ant, 10, 1))
    system, size = ant.system, chain.observation_size
    env = TASKS[task](chain, "ant")
    assert ant.system is system and chain.unwrapped is ant
    assert chain.observation_size == size == 87
    assert env.unwrapped is not ant
    assert env.unwrapped.system is not system  # pyright: ignore


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("typed", [True, False])
def test_by_hand_around_episodes(task: str, typed: bool) -> None:
    """As in the original's examples: around what ``create`` has made, eagerly."""
    key = KEY if typed else jax.random.PRNGKey(0)
    made = newton_qd.create("ant", episode_length=3)
    env = TASKS[task](made, "ant")
    inner = TASKS[task](Ant(), "ant")
    expected = AutoResetWrapper(EpisodeWrapper(inner, 3, 1))
    ours, theirs = env.reset(key), expected.reset(key)
    for _ in range(4):
        for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
            np.testing.assert_array_equal(a, b)
        assert ours.obs.shape == (env.observation_size,)
        ours = env.step(ours, action_of(env, 0.1))
        theirs = expected.step(theirs, action_of(env, 0.1))
    assert float(ours.info["steps"]) == 1  # the episode of 3 steps has ended


def test_maze_ends_episodes_inside_auto_reset() -> None:
    """The height that ends the plain ant's episode does not end one in the maze."""
    env = MazeWrapper(newton_qd.create("ant"), "ant")
    state = reset(env)(KEY)
    after = step(env)(displaced(state, 2, [1.5]), action_of(env))
    assert float(after.done) == 0
    assert float(after.pipeline_state.q[2]) > 1.4
    after = step(env)(displaced(state, 2, [6.0]), action_of(env))
    assert float(after.done) == 1
    np.testing.assert_array_equal(after.obs, after.info["first_obs"])


@pytest.mark.parametrize("task", TASKS)
def test_fixed_initial_state(task: str) -> None:
    """Whichever wrapper is put on first."""
    first = FixedInitialStateWrapper(TASKS[task](Ant(), "ant"))
    last = TASKS[task](FixedInitialStateWrapper(Ant()), "ant")
    batch = jax.jit(VectorWrapper(last, 2).reset)(KEY)
    one, other = reset(first)(KEY), reset(last)(jax.random.key(1))
    fixed = last.fixed_state()
    for state in (one, other):
        assert state.obs.shape == (last.observation_size,)
        np.testing.assert_array_equal(state.obs, fixed.obs)
        assert not np.asarray(state.pipeline_state.v).any()
    np.testing.assert_array_equal(batch.obs, np.stack([other.obs] * 2))


def test_with_scene() -> None:
    ant = Ant(healthy_reward=7.0)
    moved = ant.with_scene(TRAP)
    assert ant.system.scene is None and moved.system.scene is TRAP
    assert (ant.observation_size, moved.observation_size) == (87, 93)
    assert moved.with_scene(None).system is ant.system
    after = step(moved)(reset(moved)(KEY), action_of(moved))
    assert float(after.metrics["reward_survive"]) == 7.0
    chain = EpisodeWrapper(Wrapper(ant), 5, 1)
    other: Any = chain.with_scene(MAZE)
    assert type(other) is EpisodeWrapper and other.episode_length == 5
    assert other.system.scene is MAZE and chain.unwrapped is ant


@pytest.mark.slow
def test_precision(x64: None) -> None:
    env = MazeWrapper(Ant(dtype="float64"), "ant")
    after = env.step(env.reset(KEY), action_of(env))
    for leaf in (after.obs, after.reward, after.done):
        assert leaf.dtype == np.float64
    single = TrapWrapper(Ant(), "ant")
    after = single.step(single.reset(KEY), action_of(single))
    for leaf in (after.obs, after.reward, after.done):
        assert leaf.dtype == np.float32


@pytest.mark.parametrize("task", TASKS)
def test_other_environments_are_refused(task: str) -> None:
    message = (
        "This wrapper does not support pointmaze yet. env: got PointMaze; allowed: "
        "simulated robots whose torso floats"
    )
    with pytest.raises(NotImplementedError, match=message):
        TASKS[task](PointMaze(), "pointmaze")
    with pytest.raises(ValueError, match="env: got ant in the scene 'trap'; allowed: "):
        TASKS[task](TrapWrapper(Ant(), "ant"), "ant")
    with pytest.raises(NotImplementedError, match="pointmaze is not a simulated robot"):
        PointMaze().with_scene(TRAP)
    with pytest.raises(TypeError, match="scene: got 'maze'; allowed: None, or a Scene"):
        Ant().with_scene("maze")  # pyright: ignore[reportArgumentType]


def test_views_show_the_scene() -> None:
    """Rows of ground, maze and target come after those of the robot."""
    env: Any = newton_qd.create("antmaze", brax_views=True)
    qp = env.reset(KEY).qp
    assert qp.pos.shape == (12, 3)
    np.testing.assert_allclose(qp.pos[9:], [[0, 0, 0], [0, 0, 0], [35, 0, 0.5]])
    assert env.sys.body.index["Target"] == env.sys.body.index["target"] == 11
