"""Gradients of whole episodes: values, options, memory and faults."""

from __future__ import annotations

import functools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics_helpers import report

import newton_qd
from newton_qd.envs.state import State
from newton_qd.extractors import (
    get_feet_contact_proportion,
    get_final_xy_position,
)
from newton_qd.gradients import (
    Episode,
    EpisodeGradients,
    GradientOptions,
    make_directional_gradient,
    make_episode,
    make_episode_gradient,
    with_smooth_descriptor,
)
from newton_qd.gradients.exact import differentiate
from newton_qd.gradients.flow import passed_back
from newton_qd.gradients.outcome import Outcome
from newton_qd.gradients.plans import run_plan
from newton_qd.qd.scoring.gradient_scoring import make_gradient_scoring_function
from newton_qd.qd.scoring.task import Task

STEPS = 12


def feedback(parameters: Any, obs: jax.Array) -> jax.Array:
    """A linear policy behind a tanh, in plain JAX."""
    return jnp.tanh(parameters["w"] @ obs + parameters["b"])


def feedback_weights(env: Any, count: int, gain: float = 0.003) -> Any:
    """Weights of ``feedback``; the bias is what moves the robot.

    Feedback of velocities with a large gain makes robots chaotic: docs/gradients.md.
    """
    rng = np.random.default_rng(0)
    sizes = (count, env.action_size, env.observation_size)
    return {
        "w": (gain * rng.normal(size=sizes)).astype(env.dtype),
        "b": (0.3 * rng.normal(size=sizes[:2])).astype(env.dtype),
    }


@functools.cache
def make(name: str, dtype: str = "float64") -> Any:
    env = newton_qd.create(name, auto_reset=False, dtype=dtype)
    return with_smooth_descriptor(env, 0.02)


def task_of(name: str) -> Task:
    env = make(name)
    low, high = (np.asarray(x) for x in env.descriptor_limits)
    labels = tuple("d" * len(low))
    return Task(
        env, newton_qd.tables.descriptor_extractor[name], (low, high), labels, 0.0
    )


def norms(tree: Any) -> np.ndarray:
    """Euclidean norm of each row (n,) of leaves (n, ...)."""
    squares = [(np.asarray(x) ** 2).reshape(len(x), -1).sum(1) for x in tree]
    return np.sqrt(sum(squares))


_OTHERS = ["ant_uni", "ant_omni", "anttrap", "antmaze", "halfcheetah_uni"]
_OTHERS += ["humanoid_uni", "humanoid_omni", "humanoidtrap", "walker2d_uni"]
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in _OTHERS]


@pytest.mark.parametrize(
    "name", ["hopper_uni", pytest.param("pointmaze", marks=pytest.mark.slow), *SLOW]
)
def test_scores_have_the_gradients_of_their_differences(x64: None, name: str) -> None:
    """32 steps, along the gradient itself: relative error below 1e-4."""
    task, count = task_of(name), 4
    score = jax.jit(make_gradient_scoring_function(task, feedback, 32))
    weights, key = feedback_weights(task.env, count), jax.random.key(0)
    _, descriptors, extra = score(weights, key)
    assert not extra["faulty"].any() and not extra["overflowed"].any()
    leaves, structure = jax.tree.flatten(weights)
    gradients = jax.tree.leaves(extra["gradients"])
    worst = 0.0
    for row in range(1 + descriptors.shape[1]):
        along = [np.asarray(x[..., row]) for x in gradients]
        size = norms(along)
        moved = size > 0
        unit = 1 / np.where(moved, size, 1.0)
        errors = []
        # the nearer one where the far one is too far for the curvature there
        for change in (1e-6, 1e-7):
            distance = np.minimum(1e-5, change * unit)
            ends = []
            for sign in (1, -1):
                step = sign * distance * unit
                there = [
                    x + y * step.reshape(-1, *[1] * (y.ndim - 1))
                    for x, y in zip(leaves, along, strict=True)
                ]
                f, d, _ = score(jax.tree.unflatten(structure, there), key)
                ends.append(np.asarray(f if row == 0 else d[:, row - 1]))
            difference = (ends[0] - ends[1]) / (2 * distance)
            errors.append(np.abs(difference - size)[moved] / size[moved])
        error = np.minimum(*errors)
        worst = max(worst, error.max(initial=0.0))
        assert row or moved.all()
    report(f"{name}: largest relative error", worst)
    assert worst < 1e-4


@pytest.fixture(scope="module")
def hoppers() -> tuple[Any, Callable[..., EpisodeGradients], Any, jax.Array]:
    """Hoppers under feedback: environment, compiled gradient, weights, key."""
    env = make("hopper_uni", "float32")
    run = make_episode_gradient(
        env, feedback, get_feet_contact_proportion, episode_length=STEPS
    )
    return env, jax.jit(run), feedback_weights(env, 16), jax.random.key(3)


@pytest.mark.optimized
def test_value_is_that_without_gradient(hoppers: Any) -> None:
    env, gradient, weights, key = hoppers
    plain = make_episode(
        env, feedback, get_feet_contact_proportion, episode_length=STEPS
    )
    outcome = jax.jit(jax.vmap(plain, in_axes=(0, None)))(weights, key)
    result = gradient(weights, key)
    np.testing.assert_array_equal(result.fitnesses, outcome.fitness)
    np.testing.assert_array_equal(result.descriptors, outcome.descriptor)


def test_directions_are_sums_of_rows(hoppers: Any) -> None:
    env, gradient, weights, key = hoppers
    along = make_directional_gradient(
        env, feedback, get_feet_contact_proportion, episode_length=STEPS
    )
    directions = jnp.array([[[2.0, 0.0], [0.5, -3.0]]] * 16)
    result = jax.jit(along)(weights, directions, key)
    rows = gradient(weights, key)
    np.testing.assert_array_equal(result.fitnesses, rows.fitnesses)
    np.testing.assert_array_equal(result.descriptors, rows.descriptors)

    def check(found: jax.Array, all_rows: jax.Array) -> None:
        sums = jnp.einsum("nrk,nk...->nr...", directions, all_rows)
        size = float(jnp.abs(sums).max())
        np.testing.assert_allclose(found, sums, rtol=1e-4, atol=1e-5 * size)

    jax.tree.map(check, result.gradients, rows.gradients)


@pytest.mark.optimized
def test_worlds_and_runs_are_independent(
    hoppers: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bitwise: again, with another neighbour, and beside a faulty one."""
    monkeypatch.setenv("NEWTON_QD_LANES", "1")  # the deterministic mode of a GPU
    _, gradient, weights, key = hoppers
    first = gradient(weights, key)
    again = gradient(weights, key)
    jax.tree.map(np.testing.assert_array_equal, again, first)
    assert not first.faulty.any() and not first.overflowed.any()
    assert (norms([x[:, 0] for x in jax.tree.leaves(first.gradients)]) > 0).all()
    others = np.arange(16) != 5
    for number in (0.5, np.nan):
        changed = {**weights, "b": weights["b"].copy()}
        changed["b"][5, 0] = number
        result = gradient(changed, key)
        pairs = zip(*map(jax.tree.leaves, (result, first)), strict=True)
        for a, b in pairs:
            np.testing.assert_array_equal(a[others], b[others])
        assert bool(result.faulty[5]) == np.isnan(number)
    assert result.fitnesses[5] == -np.inf
    assert not any(np.any(x[5]) for x in jax.tree.leaves(result.gradients))
    assert not result.overflowed.any()


class Line:
    """x' = growth x + action; the reward is x', the state descriptor x.

    The state is at fault where x is above a thousand, and done above ten.
    """

    observation_size = action_size = 1

    def __init__(self, growth: float, limit: float = 10.0) -> None:
        self.growth, self.limit = growth, limit

    def reset(self, rng: jax.Array) -> State:
        del rng
        return self._state(jnp.zeros((1,), jnp.float32))

    def step(self, state: State, action: jax.Array) -> State:
        return self._state(self.growth * state.pipeline_state + action)

    def _state(self, x: jax.Array) -> State:
        return State(
            pipeline_state=x,
            obs=x,
            reward=x[0],
            done=(x[0] > self.limit).astype(jnp.float32),
            metrics={},
            info={
                "fault": (x[0] > 1000.0).astype(jnp.int32),
                "state_descriptor": x,
            },
        )


def on_line(
    growth: float, plan: Any, options: GradientOptions, limit: float = 10.0
) -> EpisodeGradients:
    plans = jnp.asarray(plan, jnp.float32)
    run = make_episode_gradient(
        Line(growth, limit),
        None,
        get_final_xy_position,
        episode_length=plans.shape[1],
        options=options,
    )
    return jax.jit(run)(plans, jax.random.key(0))


def by_hand(growth: float, steps: int, options: GradientOptions) -> np.ndarray:
    """Gradient of the fitness on the line, by the recursion of the adjoint."""
    rows, flowing = [], 0.0
    for step in reversed(range(steps)):
        rows.append(1.0 + flowing)
        flowing = growth * rows[-1]
        if options.clip is not None:
            flowing = min(flowing, options.clip)
        flowing *= options.discount
        if options.window is not None and step % options.window == 0:
            flowing = 0.0
    return np.array(rows[::-1])


@pytest.mark.parametrize(
    "options",
    [
        GradientOptions(),
        GradientOptions(window=3),
        GradientOptions(clip=2.0),
        GradientOptions(discount=0.5),
        GradientOptions(window=4, clip=2.5, discount=0.7, checkpoint_every=3),
        GradientOptions(window=4, clip=2.5, discount=0.7, checkpoint_every=None),
        GradientOptions(checkpoint_every=5),
        GradientOptions(checkpoint_every=100),
    ],
)
def test_options_compose(options: GradientOptions) -> None:
    plan = 0.1 * np.ones((2, 10, 1))
    result = on_line(1.1, plan, options)
    expected = by_hand(1.1, 10, options)
    for world in range(2):
        np.testing.assert_allclose(result.gradients[world, 0, :, 0], expected, 1e-5)
    exact = on_line(1.1, plan, GradientOptions())
    np.testing.assert_array_equal(result.fitnesses, exact.fitnesses)
    np.testing.assert_array_equal(result.descriptors, exact.descriptors)


def test_an_episode_ends_at_the_first_done() -> None:
    plan = np.ones((2, 8, 1))
    plan[0, 3] = 20.0
    result = on_line(1.0, plan, GradientOptions())
    assert result.fitnesses[0] == 1 + 2 + 3 + 23
    assert result.fitnesses[1] == sum(range(1, 9))
    np.testing.assert_array_equal(
        result.gradients[0, 0, :, 0], [4, 3, 2, 1, 0, 0, 0, 0]
    )
    # its descriptor is read before its last step
    np.testing.assert_array_equal(
        result.gradients[0, 1, :, 0], [1, 1, 1, 0, 0, 0, 0, 0]
    )


def test_no_gradient_is_silently_not_finite() -> None:
    """A fault, a gradient beyond the numbers, and a sound neighbour."""
    plan = np.zeros((3, 4, 1))
    plan[0, 1], plan[2, 3] = 2000.0, 1.0
    growth, limit = 1e20, np.inf
    result = on_line(growth, plan, GradientOptions(), limit)
    np.testing.assert_array_equal(result.faulty, [True, False, False])
    np.testing.assert_array_equal(result.overflowed[:, 0], [False, True, True])
    assert result.fitnesses[0] == -np.inf
    for leaf in (result.gradients, result.descriptors[1:], result.fitnesses[1:]):
        assert np.isfinite(leaf).all()
    assert not result.gradients[0].any() and not result.gradients[1:, 0].any()
    clipped = on_line(growth, plan, GradientOptions(clip=1.0), limit)
    assert not clipped.overflowed.any()
    np.testing.assert_array_equal(clipped.gradients[1, 0, :, 0], [2, 2, 2, 1])


def test_a_fault_after_the_end_costs_nothing() -> None:
    result = on_line(1.0, [[[1.0], [20.0], [2000.0], [0.0]]], GradientOptions())
    assert result.fitnesses[0] == 1 + 21 and not result.faulty.any()


@pytest.mark.parametrize(("fault", "counts"), [(1, True), (2, False)])
def test_steps_of_a_plan_that_count(fault: int, counts: bool) -> None:
    """Faults up to the end, and descriptors before each step."""
    rewards, done = jnp.array([1.0, 2.0, 4.0]), jnp.array([0.0, 1.0, 0.0])
    info = {
        "fault": (jnp.arange(3) == fault).astype(jnp.int32),
        "state_descriptor": rewards[:, None],
    }
    env: Any = SimpleNamespace(
        rollout=lambda *_: State((), rewards[:, None], rewards, done, {}, info)
    )
    first = SimpleNamespace(info={"state_descriptor": jnp.array([9.0])})
    plan = jnp.zeros((3, 1))
    fitness, seen, over, bad = run_plan(env, first, plan, None, described=True)
    assert fitness == 3 and over.tolist() == [False, False, True] and bad == counts
    assert seen is not None and seen[:, 0].tolist() == [9, 1, 2]


def test_a_descriptor_that_is_not_finite_is_a_fault() -> None:
    def undefined(data: Any, mask: jax.Array) -> jax.Array:
        return data.state_desc[:, 0] * jnp.nan

    found = Episode(Line(1.0), None, undefined, episode_length=2)(
        jnp.ones((2, 1)), jax.random.key(0)
    )
    assert found.faulty and found.fitness == -np.inf


@pytest.mark.parametrize("size", [0.0, 1e-30, 1.0, 1e38, 3e38])
def test_long_adjoints_are_clipped(size: float) -> None:
    _, back = jax.vjp(lambda x: passed_back(x, jnp.float32(1), 0.5), jnp.ones(2))
    (found,) = back(jnp.array([size, 0.0], jnp.float32))
    assert found.tolist() == pytest.approx([min(size, 0.5), 0.0], rel=1e-6)


def test_a_faulty_episode_has_no_gradient() -> None:
    def run(x: jax.Array) -> Outcome:
        return Outcome(x.sum(), x[:1], x[0] > 1)

    slopes = [differentiate(run, jnp.array([x, 3.0]), None).gradients for x in (0, 2)]
    assert slopes[0].tolist() == [[1, 1], [1, 0]] and not slopes[1].any()


def test_the_first_state_is_in_the_first_window() -> None:
    factors = GradientOptions(window=3, discount=0.5).factors(7)
    assert factors.tolist() == [1, 0.5, 0.5, 0, 0.5, 0.5, 0]


def test_a_gradient_that_is_cut_is_zero_whatever_it_was() -> None:
    _, back = jax.vjp(lambda x: passed_back(x, jnp.float32(0), None), jnp.ones(2))
    assert back(jnp.array([jnp.inf, jnp.nan]))[0].tolist() == [0, 0]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("window", 0),
        ("window", 2.5),
        ("clip", 0.0),
        ("clip", float("inf")),
        ("discount", 1.5),
        ("checkpoint_every", True),
    ],
)
def test_bad_options(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{name}: got {value}; allowed"):
        GradientOptions(**{name: value})


@pytest.mark.parametrize("name", ["clip", "discount"])
@pytest.mark.parametrize("value", ["a", True, [1.0]])
def test_options_that_are_no_numbers(name: str, value: Any) -> None:
    with pytest.raises(TypeError, match=rf"{name}: got .*allowed"):
        GradientOptions(**{name: value})


@pytest.mark.parametrize("length", [0, -1, 4.0, "4", None, True])
def test_an_episode_has_steps(length: Any) -> None:
    with pytest.raises(
        ValueError, match=r"episode_length: got .*; allowed: integers from 1"
    ):
        make_episode(Line(1.0), None, None, episode_length=length)


def test_an_episode_is_no_longer_than_those_of_its_environment() -> None:
    env = newton_qd.create("pointmaze", 10, action_repeat=3, auto_reset=False)
    with pytest.raises(ValueError, match="episode_length: got 5; allowed: at most 4"):
        Episode(env, episode_length=5)
    Episode(env, episode_length=4)
    endless = newton_qd.create("pointmaze", None, auto_reset=False)
    Episode(endless, episode_length=5)


def test_what_no_episode_can_be_made_of() -> None:
    """Each error names the argument and what is allowed."""
    line: Any = Line(1.0)
    with pytest.raises(TypeError, match="env: got 'hopper'; allowed"):
        make_episode("hopper", None, None, episode_length=4)  # pyright: ignore[reportArgumentType]
    options: Any = {"clip": 1.0}
    with pytest.raises(TypeError, match=r"options: got .*; allowed: GradientOptions"):
        make_episode(line, None, None, episode_length=4, options=options)
    run: Any = make_episode(line, None, None, episode_length=4)
    key, plan = jax.random.key(0), jnp.zeros((4, 1))
    with pytest.raises(TypeError, match="start: got None; allowed: a key"):
        run(plan, None)
    with pytest.raises(ValueError, match=r"genotype: got shape \(3, 1\).*\(4, 1\)"):
        run(plan[:3], key)
    states = jax.vmap(line.reset)(jax.random.split(key, 2))
    with pytest.raises(ValueError, match=r"start: .*batch of shape \(2,\)"):
        run(plan, states)
    bare: Any = newton_qd.create("hopper", auto_reset=False)
    run = make_episode(bare, None, get_final_xy_position, episode_length=4)
    with pytest.raises(ValueError, match="no state descriptor; allowed: QD tasks"):
        run(jnp.zeros((4, 3)), key)
    with pytest.raises(ValueError, match=r"^start: got .*; allowed: one key"):
        run(jnp.zeros((4, 3)), jax.random.split(key, 3))
    reset = jax.eval_shape(bare.reset, key)
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda x: jnp.zeros(x.shape, float), reset)
        with pytest.raises(
            ValueError, match="start: got a state of float64; allowed: f"
        ):
            run(jnp.zeros((4, 3)), wide)
    with pytest.raises(ValueError, match=r"genotype: got shape \(4, 3\), \(4, 3\)"):
        make_episode(bare, None, None, episode_length=4)((jnp.zeros((4, 3)),) * 2, key)
    for arguments in ((None,), ("hopper_uni",), (bare, "wide"), (bare, 0.1, "no")):
        with pytest.raises(TypeError, match="allowed"):
            with_smooth_descriptor(*arguments)  # pyright: ignore[reportArgumentType]
