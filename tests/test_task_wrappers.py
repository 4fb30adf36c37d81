"""Wrappers that make tasks: positions, rewards, and use by hand."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import newton_qd
from newton_qd import physics
from newton_qd.envs.ant import Ant
from newton_qd.envs.base import Env, QDEnv
from newton_qd.envs.pointmaze import PointMaze
from newton_qd.envs.state import State
from newton_qd.wrappers import (
    AutoResetWrapper,
    ClipRewardWrapper,
    EpisodeWrapper,
    FeetContactWrapper,
    MazeWrapper,
    NoForwardRewardWrapper,
    OffsetRewardWrapper,
    QDWrapper,
    TrapWrapper,
    VectorWrapper,
    Wrapper,
    XYPositionWrapper,
)

KEY = jax.random.key(0)


def moved_to(state: State, x: float, y: float) -> State:
    physics_state = state.pipeline_state
    q = np.array(physics_state.q)
    q[..., :2] = x, y
    moved = dataclasses.replace(physics_state, q=jnp.asarray(q))
    return state.replace(pipeline_state=moved)


def test_position_is_clipped_and_the_reading_is_not() -> None:
    env = XYPositionWrapper(Ant(), "ant", [-1.0, -2.0], [3.0, 4.0])
    step, first = jax.jit(env.step), jax.jit(env.reset)(KEY)
    for x, y in ((0.5, 0.25), (50.0, -60.0)):
        state = step(moved_to(first, x, y), np.zeros(8, np.float32))
        found = np.asarray(state.pipeline_state.q[:2])
        np.testing.assert_allclose(found, [x, y], atol=0.05)
        assert np.array_equal(state.info["xy_position"], found)
        expected = np.clip(found, [-1, -2], [3, 4])
        assert np.array_equal(state.info["state_descriptor"], expected)


def test_position_properties() -> None:
    env = XYPositionWrapper(Ant(), "ant", minval=(-1, -2), maxval=jnp.array([3.0, 4]))
    assert isinstance(env, QDEnv)
    assert env.state_descriptor_name == "xy_position"
    assert env.state_descriptor_length == env.descriptor_length == 2
    assert env.behavior_descriptor_length == 2
    for limits in (env.descriptor_limits, env.behavior_descriptor_limits):
        assert np.array_equal(limits, [[-1, -2], [3, 4]])
    low, high = XYPositionWrapper(Ant(), "ant").state_descriptor_limits
    assert low.tolist() == [-np.inf] * 2 and high.tolist() == [np.inf] * 2


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"minval": [0.0]}, r"minval: got \[0.0\]; allowed: None, or two finite"),
        ({"maxval": [[1.0, 2.0]]}, r"maxval: got .*two finite numbers"),
        ({"minval": 3.0}, r"minval: got 3.0; "),
        ({"minval": "ab"}, r"minval: got 'ab'; "),
        ({"maxval": [1.0, np.nan]}, r"maxval: got \[1.0, nan\]; "),
        ({"maxval": [1.0, np.inf]}, r"maxval: got \[1.0, inf\]; "),
        ({"minval": [0, 1], "maxval": [1, 1]}, r"minval below maxval"),
    ],
)
def test_wrong_limits(limits: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        XYPositionWrapper(Ant(), "ant", **limits)
    with pytest.raises(ValueError, match=message):
        newton_qd.create("antnotrap", qdax_wrappers_kwargs=[limits])


@pytest.mark.parametrize(
    ("place", "error", "message"),
    [
        ({"link": "hand"}, ValueError, r"link: got 'hand'; allowed: torso, aux_1, "),
        ({"link": 3}, ValueError, r"link: got 3; allowed: torso, "),
        ({"link": "foot_1", "offset": (1, 2)}, TypeError, r"offset: got \(1, 2\); "),
        (
            {"link": "foot_1", "offset": 1.0},
            TypeError,
            r"offset: got 1.0; allowed: thr",
        ),
        (
            {"link": "foot_1", "offset": (1, np.inf, 0)},
            ValueError,
            r"offset\[1\]: got inf; ",
        ),
        ({"offset": (1, 0, 0)}, ValueError, r"offset: got .*\(0.0, 0.0, 0.0\) without"),
    ],
)
def test_wrong_place(place: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        XYPositionWrapper(Ant(), "ant", **place)


@pytest.mark.parametrize(
    "wrapper", [XYPositionWrapper, NoForwardRewardWrapper, FeetContactWrapper]
)
def test_robots_only(wrapper: Callable[[Env, str], Env]) -> None:
    with pytest.raises(
        NotImplementedError, match=r"^This wrapper does not support pointmaze yet\."
    ):
        wrapper(PointMaze(), "pointmaze")


def test_position_of_a_torso_that_is_not_the_root() -> None:
    system = Ant().system
    foot = dataclasses.replace(system, torso=2)
    bodies = jax.jit(functools.partial(physics.forward_kinematics, system))
    q, v = np.float32(system.rest_q), np.zeros(system.nv, np.float32)
    action = np.full(8, 0.5, np.float32)
    for moved in (system, foot):
        start = jax.jit(functools.partial(physics.initial_state, moved))(q, v)
        for now in (
            start,
            jax.jit(functools.partial(physics.step, moved))(start, action)[0],
        ):
            expected = np.asarray(bodies(now.q, now.v).position)[moved.torso, :2]
            np.testing.assert_array_equal(now.torso_xy, expected)


def test_forward_reward_is_taken_away() -> None:
    plain, env = Ant(), NoForwardRewardWrapper(Ant(), "ant")
    state = jax.jit(plain.reset)(KEY)
    assert float(jax.jit(env.reset)(KEY).reward) == 0.0
    action = np.full(8, 0.5, np.float32)
    expected, found = (
        jax.jit(plain.step)(state, action),
        jax.jit(env.step)(state, action),
    )
    forward = expected.metrics["reward_forward"]
    assert abs(float(forward)) > 1e-3
    np.testing.assert_allclose(found.reward, expected.reward - forward, rtol=1e-6)
    assert found.metrics["reward_forward"] == forward


class Runner(Ant):
    """An ant whose forward metric has another name, as halfcheetah's has."""

    forward_reward_name = "reward_run"

    def outcome(self, before: Any, after: Any, action: Any) -> Any:
        reward, done, metrics = super().outcome(before, after, action)
        return reward, done, {"reward_run": metrics["reward_forward"]}


def test_forward_metric_is_named_by_the_class() -> None:
    # the original knows one name for halfcheetah and its environment another
    env = NoForwardRewardWrapper(Runner(), "runner")
    action = jax.ShapeDtypeStruct((8,), np.float32)
    state = jax.eval_shape(env.step, jax.eval_shape(env.reset, KEY), action)
    assert set(state.metrics) == {"reward_run"}


def test_forward_reward_and_repeated_actions() -> None:
    with pytest.raises(ValueError, match=r"repeats actions 2 times.*EpisodeWrapper"):
        NoForwardRewardWrapper(newton_qd.create("ant", action_repeat=2), "ant")
    with pytest.raises(ValueError, match=r"forward part would be subtracted twice"):
        NoForwardRewardWrapper(newton_qd.create("ant_omni"), "ant")
    env = newton_qd.create("ant_omni", action_repeat=2)
    single = newton_qd.create("ant_omni")
    state, action = jax.jit(env.reset)(KEY), jnp.full(8, 0.5, np.float32)
    once = jax.jit(single.step)(state, action)
    twice = jax.jit(single.step)(once, action)
    both = jax.jit(env.step)(state, action)
    np.testing.assert_allclose(both.reward, once.reward + twice.reward, rtol=1e-6)


def rewards(env: Env) -> tuple[float, float]:
    """Of the reset, and of a step that costs 0.8 in the maze."""
    state = env.reset(KEY)
    state = env.step(state, jnp.zeros(2, np.float32))
    return float(env.reset(KEY).reward), float(state.reward)


def test_clip_reward() -> None:
    plain = rewards(PointMaze())[1]
    assert plain < -1.0
    assert rewards(ClipRewardWrapper(PointMaze())) == (0.0, plain)
    assert rewards(ClipRewardWrapper(PointMaze(), clip_min=-0.5)) == (0.0, -0.5)
    assert rewards(ClipRewardWrapper(PointMaze(), clip_max=-0.5)) == (-0.5, plain)
    assert rewards(ClipRewardWrapper(PointMaze(), -0.5, -0.25)) == (-0.25, -0.5)
    assert rewards(ClipRewardWrapper(PointMaze(), -0.5, -0.5)) == (-0.5, -0.5)
    with pytest.raises(ValueError, match=r"clip_min, clip_max: got \(1.0, 0.0\)"):
        ClipRewardWrapper(PointMaze(), 1.0, 0.0)
    with pytest.raises(
        ValueError, match=r"clip_max: got nan; allowed: None, or number"
    ):
        ClipRewardWrapper(PointMaze(), clip_max=np.nan)
    text: Any = "1"
    with pytest.raises(
        ValueError, match=r"clip_min: got '1'; allowed: None, or number"
    ):
        ClipRewardWrapper(PointMaze(), clip_min=text)
    with pytest.raises(TypeError, match=r"offset: got '1'; allowed: finite numbers"):
        OffsetRewardWrapper(PointMaze(), offset=text)


def test_offset_reward() -> None:
    plain = rewards(PointMaze())[1]
    assert rewards(OffsetRewardWrapper(PointMaze())) == (0.0, plain)
    found = rewards(OffsetRewardWrapper(PointMaze(), offset=2.3431))
    np.testing.assert_allclose(found, (2.3431, plain + 2.3431), rtol=1e-6)
    for wrong in (np.nan, np.inf):
        with pytest.raises(ValueError, match=r"offset: got .*finite"):
            OffsetRewardWrapper(PointMaze(), wrong)


def test_rewards_keep_their_type_under_x64(x64: None) -> None:
    env = OffsetRewardWrapper(PointMaze(), np.float64(1.0))
    env = ClipRewardWrapper(env, np.float64(0.0), np.float64(2.0))
    state = jax.eval_shape(env.reset, KEY)
    state = jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((2,), np.float32))
    assert state.reward.dtype == np.float32 and not state.reward.weak_type


def test_offset_then_clip_around_a_created_environment() -> None:
    # as the original uses them
    env = newton_qd.create("ant_omni", episode_length=3)
    env = OffsetRewardWrapper(env, offset=newton_qd.tables.reward_offset["ant_omni"])
    env = ClipRewardWrapper(env, clip_min=0.0)
    state = jax.jit(env.reset)(KEY)
    assert float(state.reward) == np.float32(newton_qd.tables.reward_offset["ant_omni"])
    state = jax.jit(env.step)(state, 10.0 * jnp.ones(8, np.float32))
    assert float(state.reward) == 0.0
    assert env.state_descriptor_length == 2  # pyright: ignore


def test_qd_wrapper_forwards_the_descriptor() -> None:
    inside = AutoResetWrapper(PointMaze())
    env = QDWrapper(inside)
    assert isinstance(env, QDEnv) and env.unwrapped is inside.unwrapped
    assert env.state_descriptor_name == "xy_position"
    assert env.state_descriptor_length == env.descriptor_length == 2
    assert env.behavior_descriptor_length == 2
    for limits in (
        env.state_descriptor_limits,
        env.descriptor_limits,
        env.behavior_descriptor_limits,
    ):
        assert np.array_equal(limits, [[-1, -1], [1, 1]])
    assert env.reset(KEY).obs.tolist() == inside.reset(KEY).obs.tolist()
    assert not hasattr(QDWrapper(Ant()), "descriptor_length")


class Height(QDWrapper):
    """Written for QDax 0.4: the descriptor of an episode has limits of its own."""

    @property
    def state_descriptor_length(self) -> int:
        return 1

    @property
    def state_descriptor_limits(self) -> tuple[jax.Array, jax.Array]:
        return jnp.array([-jnp.inf]), jnp.array([jnp.inf])

    @property
    def behavior_descriptor_length(self) -> int:
        return 1

    @property
    def behavior_descriptor_limits(self) -> tuple[jax.Array, jax.Array]:
        return jnp.zeros(1), jnp.ones(1)


class HigherHeight(Height):
    @property
    def descriptor_limits(self) -> tuple[jax.Array, jax.Array]:
        return jnp.zeros(1), 2 * jnp.ones(1)


class LowHeight:
    @property
    def behavior_descriptor_limits(self) -> tuple[jax.Array, jax.Array]:
        return -jnp.ones(1), jnp.zeros(1)


class LowerHeight(LowHeight, HigherHeight):
    pass


@pytest.mark.parametrize(
    ("kind", "limits"),
    [
        (Height, [[0], [1]]),
        (HigherHeight, [[0], [2]]),
        (LowerHeight, [[-1], [0]]),
    ],
)
@pytest.mark.parametrize("inside", [Ant, PointMaze])
def test_one_name_of_the_descriptor_is_enough(
    kind: type[QDWrapper], limits: list[list[int]], inside: Callable[[], Env]
) -> None:
    env = kind(inside())
    assert env.descriptor_length == env.behavior_descriptor_length == 1
    for found in (env.descriptor_limits, env.behavior_descriptor_limits):
        assert np.array_equal(found, limits)
    assert not np.all(np.isfinite(env.state_descriptor_limits))


def test_limits_of_an_episode_by_their_new_name() -> None:
    class Bounded(PointMaze):
        @property
        def descriptor_limits(self) -> tuple[jax.Array, jax.Array]:
            return -2 * jnp.ones(2), 2 * jnp.ones(2)

    env = Bounded()
    for found in (env.descriptor_limits, env.behavior_descriptor_limits):
        assert np.array_equal(found, [[-2, -2], [2, 2]])


@functools.cache
def by_hand(wrapper: Callable[[Env, str], Env]) -> Any:
    return wrapper(newton_qd.create("ant", episode_length=3), "ant")


@pytest.mark.parametrize("key", [jax.random.PRNGKey(0), KEY], ids=["uint32", "typed"])
@pytest.mark.parametrize("wrapper", [FeetContactWrapper, XYPositionWrapper])
def test_examples_of_the_original(
    wrapper: Callable[[Env, str], Env], key: jax.Array
) -> None:
    # by hand, not jitted, around an environment with Episode and AutoReset
    qd_env = by_hand(wrapper)
    state = first = qd_env.reset(rng=key)
    for _ in range(4):
        action = jnp.zeros((qd_env.action_size,))
        state = qd_env.step(state, action)
        assert state.info["state_descriptor"].shape == (qd_env.descriptor_length,)
        if state.done:
            assert same_readings(state, first)
    assert float(state.info["steps"]) == 1.0
    if wrapper is XYPositionWrapper:
        assert state.info["xy_position"].shape == (2,)


def same_readings(state: State, other: State) -> bool:
    return all(
        np.array_equal(state.info[key], other.info[key])
        for key in ("state_descriptor", "xy_position")
        if key in other.info
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "wrapper", [FeetContactWrapper, XYPositionWrapper, NoForwardRewardWrapper]
)
def test_around_a_batch_as_inside_it(wrapper: Callable[[Env, str], Env]) -> None:
    inside = AutoResetWrapper(
        VectorWrapper(EpisodeWrapper(wrapper(Ant(), "ant"), 9, 1), 3)
    )
    around = wrapper(newton_qd.create("ant", episode_length=9, batch_size=3), "ant")
    found = []
    for env in (inside, around):
        state = jax.jit(env.reset)(KEY)
        for _ in range(6):
            state = jax.jit(env.step)(state, jnp.full((3, 8), 0.3, np.float32))
        found.append(state)
    assert np.array_equal(found[0].reward, found[1].reward)
    assert same_readings(found[1], found[0])


def test_position_follows_the_auto_reset() -> None:
    env = newton_qd.create("ant_omni", episode_length=2)
    state = first = jax.jit(env.reset)(KEY)
    for _ in range(2):
        state = jax.jit(env.step)(state, jnp.ones(8, np.float32))
    assert float(state.done) == 1.0
    assert same_readings(state, first)
    assert np.array_equal(state.info["xy_position"], state.pipeline_state.q[:2])


class Longer(Wrapper):
    """One more number in an observation."""

    @property
    def observation_size(self) -> int:
        return self.env.observation_size + 1


def test_a_wrapper_below_a_scene_may_make_observations_longer() -> None:
    env = newton_qd.create("ant", episode_length=None, auto_reset=False)
    for kind in (TrapWrapper, MazeWrapper):
        alone = kind(env, "ant").observation_size
        assert kind(Longer(env), "ant").observation_size == alone + 1
