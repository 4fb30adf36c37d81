"""The gradient of ``done``: its values stay, and a learner sees a fall ahead."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_runs import PointEnv

import newton_qd
from newton_qd.envs.base import Env, PhysicsEnv
from newton_qd.envs.limits import within
from newton_qd.envs.state import State
from newton_qd.gradients import (
    Episode,
    GradientOptions,
    diagnose_gradients,
    with_smooth_termination,
)
from newton_qd.qd.emitters.actor_critic_learner import ActorCritic
from newton_qd.qd.emitters.actor_critic_settings import ActorCriticSettings
from newton_qd.wrappers.maze import MazeWrapper

WIDTH = 0.05
NAMES = (
    *("hopper_uni", "walker2d_uni", "ant_uni", "humanoid_uni", "quadruped_uni"),
    *("inverted_pendulum", "inverted_double_pendulum"),
)


def logistic(x: float) -> float:
    return 1 / (1 + math.exp(-x))


@pytest.mark.parametrize("limits", [(0.2, 1.0), (0.2, math.inf), (-math.inf, 1.0)])
def test_within_is_a_step_with_the_slope_of_a_smooth_one(limits: Any) -> None:
    """Against the derivative in closed form, in float64."""
    low, high = limits
    with jax.enable_x64(True):
        steep, smooth = (
            jax.jit(
                lambda x, w=w: (within(x, limits, w), jax.grad(within)(x, limits, w))
            )
            for w in (None, WIDTH)
        )
        for x in np.array([-0.1, 0.15, 0.2, 0.3, 0.97, 1.0, 1.02, 3.0], np.float64):
            value = float(x)
            inside = low <= value <= high
            (wide, slope), (narrow, found) = smooth(x), steep(x)
            assert wide == narrow == inside
            slopes = [
                sign * logistic(margin / WIDTH) * logistic(-margin / WIDTH) / WIDTH
                for sign, margin in ((1, value - low), (-1, high - value))
            ]
            expected = slopes[0] * (value <= high) + slopes[1] * (value >= low)
            np.testing.assert_allclose(slope, expected, rtol=1e-12, atol=1e-300)
            assert found == 0


def _robot(env: Env) -> PhysicsEnv:
    robot = env.unwrapped
    assert isinstance(robot, PhysicsEnv)
    return robot


@pytest.mark.parametrize("name", NAMES)
def test_done_has_a_gradient_near_its_limit(name: str) -> None:
    """The wrapped environment changes; the first one, and every value, do not."""
    env = newton_qd.create(name, auto_reset=False)
    smooth = with_smooth_termination(env, WIDTH)
    kinds = [_robot(env), _robot(smooth)]
    assert [kind.termination_width for kind in kinds] == [None, WIDTH]
    rest = jax.jit(kinds[0].fixed_state)().pipeline_state
    action = jnp.zeros((env.action_size,))
    fallen = rest.q * 0.3  # lower
    if "pendulum" in name:
        fallen = rest.q.at[1].add(1.5)
    elif name in ("hopper_uni", "walker2d_uni"):
        fallen = fallen.at[2].add(0.7)  # and leaning

    def done(share: jax.Array, robot: Any) -> jax.Array:
        state = dataclasses.replace(rest, q=rest.q + share * (fallen - rest.q))
        return robot.outcome(state, state, action)[1]

    shares = jnp.linspace(0, 1, 41)
    (plain, flat), (value, slope) = (
        jax.jit(jax.vmap(jax.value_and_grad(functools.partial(done, robot=kind))))(
            shares
        )
        for kind in kinds
    )
    np.testing.assert_array_equal(plain, value)
    assert set(np.asarray(value)) <= {0, 1}
    assert not flat.any() and np.isfinite(slope).all()
    # who falls further is nearer to the end
    assert slope.max() > 0.1 and slope.min() > -1e-6


@pytest.mark.parametrize("name", ["antmaze", "humanoid_maze"])
def test_a_maze_has_a_gradient_of_done(name: str) -> None:
    """A maze has limits of its own."""
    env = newton_qd.create(name, auto_reset=False)
    smooth = with_smooth_termination(env, WIDTH)
    state = jax.jit(env.reset)(jax.random.key(0))
    wrapper: Any = smooth
    while not isinstance(wrapper, MazeWrapper):
        wrapper = wrapper.env

    def done(height: jax.Array) -> jax.Array:
        moved = state.pipeline_state
        moved = dataclasses.replace(moved, q=moved.q.at[2].set(height))
        return wrapper._outcome(state.replace(pipeline_state=moved)).done

    gradient = jax.jit(jax.value_and_grad(done))
    low, _ = wrapper.heights
    for height, ended in ((low + WIDTH, 0), (low - WIDTH, 1)):
        value, slope = gradient(np.float32(height))
        side = logistic(1.0) * logistic(-1.0) / WIDTH
        assert value == ended
        np.testing.assert_allclose(slope, -side, rtol=1e-5)


@pytest.mark.parametrize("name", ["hopper_uni", "ant_uni", "humanoid_uni"])
def test_the_reward_keeps_its_gradient(name: str) -> None:
    """Also where an unhealthy robot does not end an episode, but loses a bonus."""
    env = newton_qd.create(name, auto_reset=False, terminate_when_unhealthy=False)
    kinds = [_robot(env), _robot(with_smooth_termination(env, WIDTH))]
    rest = jax.jit(kinds[0].fixed_state)().pipeline_state

    def reward(q: jax.Array, robot: Any) -> jax.Array:
        state = dataclasses.replace(rest, q=q)
        return robot.outcome(rest, state, jnp.zeros((env.action_size,)))[0]

    gradient = jax.jit(jax.grad(reward), static_argnums=1)
    one, two = (gradient(rest.q, kind) for kind in kinds)
    np.testing.assert_array_equal(one, two)


def test_the_values_of_a_step_stay_the_same() -> None:
    env = newton_qd.create("hopper_uni", auto_reset=False)
    smooth = with_smooth_termination(env, WIDTH)
    state = jax.jit(env.reset)(jax.random.key(0))
    fallen = False
    steps = [jax.jit(kind.step) for kind in (env, smooth)]
    for action in np.ones((100, 3), np.float32):
        first, second = (step(state, action) for step in steps)
        for one, two in zip(*map(jax.tree.leaves, (first, second)), strict=True):
            np.testing.assert_array_equal(one, two)
        state, fallen = first, fallen or bool(first.done)
    assert fallen


class Cliff(PointEnv):
    """A point that falls where x is above 0.5; each step is worth 1."""

    def __init__(self, width: float | None) -> None:
        self.width = width

    def step(self, state: Any, action: jax.Array) -> Any:
        after = super().step(state, action)
        safe = within(after.pipeline_state[0], (-math.inf, 0.5), self.width)
        one = jnp.ones_like(after.reward)
        return dataclasses.replace(after, reward=one, done=1 - safe)


def cliff_gradient(width: float | None, start: float) -> jax.Array:
    """Gradient of a window's return with respect to the mean action (2,)."""
    settings = ActorCriticSettings(
        worlds=1, window=4, batches=1, noise=0.0, critic=(4,), discount=0.9, clip=1e6
    )
    env = Cliff(width)
    way = ActorCritic(
        env,
        lambda weights, obs: weights,
        lambda before, after: jnp.zeros(2),
        9,
        settings,
    )
    first = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 1))
    begin = jax.jit(way.begin)
    begun = begin(jax.random.key(1), jnp.zeros(2), jnp.array([1.0, 0, 0]), first)
    # a critic that gives 10 everywhere
    flat = jax.tree.map(jnp.zeros_like, begun.target)
    flat[-1] = (flat[-1][0], jnp.ones_like(flat[-1][1]))
    begun = dataclasses.replace(begun, target=flat)
    one = jax.tree.map(lambda x: x[0], first)
    one = dataclasses.replace(
        one, pipeline_state=jnp.array([start, 0.0]), obs=jnp.array([start, 0.0, 1.0])
    )
    scale = jnp.zeros(3), jnp.ones(3)

    def total(weights: jax.Array) -> jax.Array:
        return way._window(weights, begun, scale, one, one, jnp.zeros((4, 2)))[0]

    return jax.jit(jax.grad(total))(jnp.zeros(2))


@pytest.mark.parametrize("start", [0.4, 0.55])
def test_an_actor_sees_that_a_fall_is_near(start: float) -> None:
    """It moves away from the cliff, both shortly before it and after it fell."""
    blind, seeing = (cliff_gradient(width, start) for width in (None, 0.1))
    assert not np.any(blind)
    assert seeing[0] < -0.1 and seeing[1] == 0


@pytest.mark.parametrize("push", [0.05, 0.4])
def test_an_episode_sees_that_its_end_is_near(push: float) -> None:
    """Against the derivative in closed form: a step is worth 1, until the cliff."""
    plan = np.full((6, 2), push, np.float32)
    x = np.cumsum(0.3 * plan[:, 0])
    fallen = np.append(False, np.cumsum(x > 0.5)[:-1] > 0)
    counted = np.sum(~fallen)
    rest = np.maximum(counted - 1 - np.arange(6), 0)  # steps after each step
    slopes = np.array([logistic(v) * logistic(-v) for v in (x - 0.5) / 0.1]) / 0.1
    expected = -0.3 * np.cumsum((slopes * rest)[::-1])[::-1]
    for width, expected_ in ((None, 0 * expected), (0.1, expected)):
        episode = Episode(Cliff(width), episode_length=6)
        start = Cliff(width)._state(jnp.zeros(2), jnp.zeros(()))
        found = episode.gradient(plan[None], start)
        assert found.fitnesses[0] == counted
        slope = found.gradients[0, 0]
        np.testing.assert_allclose(slope[:, 0], expected_, rtol=2e-5, atol=1e-7)
        assert not slope[:, 1].any()


class Ended(PointEnv):
    """Ends at the third step with some done; later done and reward are not finite."""

    def __init__(self, done: Any) -> None:
        self.done = done

    def step(self, state: Any, action: jax.Array) -> Any:
        after = super().step(state, action)
        count = state.info["count"] + 1
        over = jnp.where(count > 3, jnp.nan, (count == 3) * self.done)
        one = jnp.where(count > 3, jnp.nan, jnp.ones_like(after.reward))
        info = {**after.info, "count": count}
        return dataclasses.replace(after, reward=one, done=over, info=info)


@pytest.mark.parametrize("done", [1.0, 2.0, 0.5, np.float32(1)])
def test_an_end_is_any_done_above_zero(done: Any) -> None:
    """What comes after the end does not count, whatever it is."""
    with jax.enable_x64(True):
        env = Ended(jnp.asarray(done))
        first = env._state(jnp.zeros(2, np.float32), jnp.zeros((), np.float32))
        info, begun = {**first.info, "count": 0}, jnp.zeros_like(env.done)
        first = dataclasses.replace(first, done=begun, info=info)
        plan = jnp.zeros((1, 6, 2), np.float32)
        found = Episode(env, episode_length=6).gradient(plan, first)
        assert found.fitnesses[0] == 3 and not found.faulty[0]
        assert not found.gradients.any()


def test_a_plan_sees_that_its_end_is_near() -> None:
    """All physics in one call, and in steps: the same gradient."""
    env = newton_qd.create("hopper_uni", auto_reset=False)
    plan = 0.1 * jnp.ones((1, 60, 3))  # falls after about 40 steps
    key = jax.random.key(0)

    def found(env: Env, every: int | None) -> Any:
        options = GradientOptions(checkpoint_every=every)
        episode = Episode(env, episode_length=60, options=options)
        return episode.gradient(plan, key)

    smooth = with_smooth_termination(env, WIDTH)
    blind, once, steps = found(env, None), found(smooth, None), found(smooth, 30)
    np.testing.assert_array_equal(blind.fitnesses, once.fitnesses)
    np.testing.assert_array_equal(once.fitnesses, steps.fitnesses)
    scale = np.abs(once.gradients).max()
    np.testing.assert_allclose(once.gradients, steps.gradients, atol=1e-4 * scale)
    assert np.abs(once.gradients - blind.gradients).max() > 0.1 * scale


class Ending:
    """A point that pays 1 a step; ``done`` is 0, with a slope of 0.1 in its place."""

    observation_size = action_size = 1
    dtype, dt, name = np.dtype("float64"), 0.1, "ending"

    def reset(self, rng: jax.Array) -> State:
        del rng
        return self._state(jnp.zeros((1,)))

    def step(self, state: State, action: jax.Array) -> State:
        return self._state(state.pipeline_state + action)

    def _state(self, x: jax.Array) -> State:
        slope = 0.1 * x[0]
        done = slope - jax.lax.stop_gradient(slope)
        return State(x, x, jnp.ones_like(done), done, {}, {})


PAID = np.array([-0.6, -0.3, -0.1, 0.0])  # each step costs 0.1 of all rewards after it


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (GradientOptions(), PAID),
        (GradientOptions(window=1), np.zeros(4)),
        (GradientOptions(window=2), np.array([-0.1, 0.0, -0.1, 0.0])),
        (GradientOptions(discount=0.0), np.zeros(4)),
    ],
)
def test_a_window_cuts_the_slope_of_an_end(
    options: GradientOptions, expected: np.ndarray
) -> None:
    """A reward after a window has no slope in it, also by way of ``done``."""
    with jax.enable_x64(True):
        episode = Episode(Ending(), episode_length=4, options=options)
        plan, key = jnp.zeros((1, 4, 1)), jax.random.key(0)
        found = episode.gradient(plan, key).gradients[0, 0, :, 0]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_the_doctor_sees_the_slope_of_an_end() -> None:
    """The gradient that it diagnoses is that of an episode."""
    with jax.enable_x64(True):
        plans = np.zeros((2, 4, 1))
        report = diagnose_gradients(Ending(), genotypes=plans, horizons=(4,))  # pyright: ignore[reportArgumentType]
    assert report.horizons[0].largest_norm == pytest.approx(np.linalg.norm(PAID))


def test_another_environment_stays_as_it_is() -> None:
    env: Any = PointEnv()
    assert with_smooth_termination(env, WIDTH) is env


@pytest.mark.parametrize("width", [0.0, -1.0, 1e-39, math.nan, math.inf, True, "0.05"])
def test_a_wrong_width_is_refused(width: Any) -> None:
    env = newton_qd.create("hopper_uni")
    error = ValueError if type(width) is float else TypeError
    with pytest.raises(error, match="width: got"):
        with_smooth_termination(env, width)
    with pytest.raises(error, match="width: got"):
        within(jnp.zeros(()), (0.0, 1.0), width)


def test_the_type_of_the_width_does_not_matter() -> None:
    with jax.enable_x64(True):
        one = jnp.ones((), jnp.float32)
        assert within(one, (np.float64(0), 2), np.float64(WIDTH)).dtype == jnp.float32
        slope = jax.grad(within)(one, (np.float64(1), 2), np.float64(WIDTH))
        np.testing.assert_allclose(slope, 1 / (4 * WIDTH), rtol=1e-6)
