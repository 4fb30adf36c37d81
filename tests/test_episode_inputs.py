"""Episodes from a given state and with given parameters, and their gradients."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import line_env
import numpy as np
import pytest
from contract import same
from physics_helpers import report
from test_episode_gradients import Line, make

import newton_qd
from newton_qd import physics
from newton_qd.envs.pointmaze import PointMaze
from newton_qd.envs.state import State
from newton_qd.extractors import get_feet_contact_proportion
from newton_qd.gradients import (
    Episode,
    GradientOptions,
    make_episode,
    make_episode_gradient,
    with_smooth_descriptor,
)
from newton_qd.wrappers import EpisodeWrapper

STEPS, KEY = 16, jax.random.key(3)


@functools.cache
def hopping(dtype: str = "float64") -> Any:
    """A hopper, its episode under a plan, jitted too, and a plan."""
    # wide: friction hardly changes the load of the foot
    env = with_smooth_descriptor(make("hopper_uni", dtype), 1.0)
    episode = make_episode(env, None, get_feet_contact_proportion, episode_length=STEPS)
    plan = np.random.default_rng(0).uniform(-0.5, 0.5, (STEPS, env.action_size))
    return env, episode, jax.jit(episode), plan.astype(env.dtype)


def test_a_state_and_its_key_begin_the_same_episode() -> None:
    env, _, episode, plan = hopping("float32")
    start = jax.jit(env.reset)(KEY)
    assert same(episode(plan, start), episode(plan, KEY))
    assert same(episode(plan, KEY, env.default_params), episode(plan, KEY))
    # further on, what is left of an episode
    later = jax.jit(env.step)(start, plan[0])
    rest = make_episode(env, None, None, episode_length=STEPS - 1)
    whole = episode(plan, KEY).fitness
    part = jax.jit(rest)(plan[1:], later).fitness
    assert later.reward + part == pytest.approx(float(whole), rel=1e-6)


@pytest.mark.slow
def test_gradients_to_first_state_and_parameters(x64: None) -> None:
    """Of fitness and descriptor, along a random direction of each: below 1e-6."""
    env, episode, _, plan = hopping()
    first = jax.jit(env.reset)(KEY)
    # on the ground, and sliding
    seen = first.pipeline_state
    where = {"q": seen.q.at[1].add(-0.02), "v": seen.v.at[0].add(1.0)}
    given = {**where, **vars(env.default_params)}

    def values(given: dict[str, jax.Array]) -> jax.Array:
        params = {k: x for k, x in given.items() if k not in where}
        start = physics.initial_state(env.system, given["q"], given["v"])
        state = first.replace(pipeline_state=start)
        outcome = episode(plan, state, physics.PhysicsParams(**params))
        return jnp.append(outcome.fitness, outcome.descriptor)

    jacobian = jax.jit(jax.jacrev(values))(given)
    value, rng = jax.jit(values), np.random.default_rng(1)
    for name, x in given.items():
        direction = rng.normal(size=x.shape)
        rows = np.asarray(jacobian[name]).reshape(2, -1)
        assert rows.any(axis=1).all(), name
        size = np.linalg.norm(rows, axis=1) * np.linalg.norm(direction)
        errors = []
        # what moves the hopper little needs a distance that its rounding does not see
        for distance in (1e-6, 1e-4):
            ahead, behind = (
                value({**given, name: x + sign * distance * direction})
                for sign in (1, -1)
            )
            difference = np.asarray(ahead - behind) / (2 * distance)
            errors.append(np.abs(rows @ direction.ravel() - difference) / size)
        error = np.minimum(*errors)
        report(f"largest relative error, {name}", error.max())
        assert error.max() < 1e-6, name


def test_worlds_share_launches_with_parameters_of_their_own() -> None:
    env, _, _, plan = hopping("float32")
    episode = make_episode(env, None, None, episode_length=STEPS)
    default = env.default_params
    friction = jnp.array([0.2, 1.0], jnp.float32)
    several = jax.vmap(
        lambda f: episode(plan, KEY, default.replace(friction=f)).fitness
    )
    found = jax.jit(several)(friction)
    assert found[0] != found[1]
    alone = jax.jit(episode)(plan, KEY, default.replace(friction=friction[0]))
    assert found[0] == alone.fitness


def on_line(options: GradientOptions | None) -> jax.Array:
    """Gradient of the return of eight steps to where they begin."""
    episode = make_episode(Line(1.1), None, None, episode_length=8, options=options)
    first = Line(1.1).reset(KEY)

    def fitness(x: jax.Array) -> jax.Array:
        state: State = first.replace(pipeline_state=x)
        return episode(jnp.zeros((8, 1), jnp.float32), state).fitness

    return jax.jit(jax.grad(fitness))(jnp.ones((1,), jnp.float32))[0]


def test_the_first_window_reaches_the_first_state() -> None:
    powers = 1.1 ** np.arange(1, 9)
    assert on_line(None) == pytest.approx(powers.sum(), rel=1e-5)
    window = GradientOptions(window=3)
    assert on_line(window) == pytest.approx(powers[:3].sum(), rel=1e-5)
    discounted = GradientOptions(discount=0.5)
    expected = 1.1 * ((0.5 * 1.1) ** np.arange(8)).sum()
    assert on_line(discounted) == pytest.approx(expected, rel=1e-5)


def test_no_descriptor() -> None:
    gradient = make_episode_gradient(Line(1.0), None, None, episode_length=4)
    result = jax.jit(gradient)(jnp.zeros((2, 4, 1), jnp.float32), KEY)
    assert result.descriptors.shape == (2, 0)
    np.testing.assert_array_equal(result.gradients[:, 0, :, 0], [[4, 3, 2, 1]] * 2)


def test_parameters_are_checked_before_anything_is_compiled() -> None:
    """In a batch and in an episode, their values are not known any more."""
    env = newton_qd.create("hopper", auto_reset=False)
    wrong = env.default_params.replace(friction=-jnp.ones(()))
    episode, plan = Episode(env, episode_length=3), jnp.zeros((3, 3))
    batch = newton_qd.create("hopper", batch_size=2, auto_reset=False)
    shapes = jax.eval_shape(batch.reset, KEY)
    state = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    many = jax.tree.map(lambda x: jnp.stack([x, x]), wrong)
    for run in (
        lambda: episode(plan, KEY, wrong),
        lambda: episode.gradient(plan[None], KEY, wrong),
        lambda: batch.step(state, jnp.zeros((2, 3)), many),
    ):
        with pytest.raises(ValueError, match=r"^params\.friction: got -1\.0; allowed"):
            run()


def test_genotypes_are_several() -> None:
    """Their number is that of the episodes."""
    _, episode, _, plan = hopping("float32")
    weights = jnp.ones((1, 1, 1))
    for wrong, shown in (
        ({}, "no leaves"),
        (1.0, r"leaves of shape \(\)"),
        ({"a": plan, "b": plan[:3]}, r"leaves of shape \(16, 3\), \(3, 3\)"),
    ):
        for method in (
            lambda given: episode.directional(given, weights, KEY),
            lambda given: episode.gradient(given, KEY),
            lambda given: episode.mixed(given, KEY),
            lambda given: episode.scoring()(given, KEY),
        ):
            with pytest.raises(ValueError, match=f"genotypes: got {shown}; allowed: "):
                method(wrong)


def test_transitions_need_no_wrapper() -> None:
    """Only an ``EpisodeWrapper`` cuts episodes; without one, none is cut."""
    env = PointMaze()
    episode = newton_qd.Episode(env, None, episode_length=3, transitions=True)
    found = episode(jnp.zeros((3, 2)), jax.random.key(0)).transitions
    assert found["truncations"].tolist() == [0, 0, 0]


class Failing(line_env.Line):
    """A line with a fault beyond 1."""

    def step(self, state: State, action: jax.Array, params: Any = None) -> State:
        after = super().step(state, action, params)
        fault = (after.pipeline_state > 1).astype(np.int32)
        return after.replace(info={**after.info, "fault": fault})


def test_a_faulty_episode_has_no_gradient() -> None:
    """Also of its descriptor, which is known."""
    episode = Episode(
        Failing(), None, lambda data, _: data.state_desc[:, -1], episode_length=3
    )
    plans = jnp.array([[[0.1]] * 3, [[1.0]] * 3])
    found = episode.gradient(plans, KEY)
    assert found.faulty.tolist() == [False, True] and not found.overflowed.any()
    assert found.gradients[0, 1].any() and not found.gradients[1].any()
    assert np.isfinite(found.descriptors).all()


def test_a_descriptor_that_is_not_finite_is_a_fault() -> None:
    """The fitness alone does not say so."""
    episode = Episode(
        line_env.Line(),
        None,
        lambda data, _: jnp.log(data.state_desc[:, -1]),
        episode_length=2,
    )
    found = jax.vmap(episode, (0, None))(jnp.array([[[1.0]] * 2, [[-1.0]] * 2]), KEY)
    assert found.faulty.tolist() == [False, True]
    assert np.isfinite(found.fitness).tolist() == [True, False]
    assert jnp.all(jnp.isfinite(jnp.asarray(found.reward_sum)))


def test_a_gradient_that_one_leaf_has_lost_is_lost() -> None:
    def policy(tree: Any, obs: jax.Array) -> jax.Array:
        del obs
        return tree["a"] + 0 * jnp.sqrt(tree["b"])

    episode = Episode(line_env.Line(), policy, episode_length=2)
    genotypes = {"a": jnp.ones((2, 1)), "b": jnp.array([[0.0], [1.0]])}
    found = episode.gradient(genotypes, KEY)
    assert found.overflowed.tolist() == [[True], [False]]
    assert found.gradients["a"].ravel().tolist() == [0, 3]


def test_transitions_go_on_with_another_episode() -> None:
    episode = Episode(line_env.Line(end=2.0), episode_length=5, transitions=True)
    found = episode(jnp.ones((5, 1)), KEY)
    steps = {name: np.ravel(x) for name, x in found.transitions.items()}
    start = steps["obs"][0]
    assert 0 < start < 0.5
    np.testing.assert_allclose(steps["obs"] - start, [0, 1, 0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(steps["next_obs"] - start, [1, 2, 1, 2, 1], atol=1e-6)
    # the state descriptor and the reward of this environment are the position
    assert np.array_equal(steps["state_desc"], steps["obs"])
    assert np.array_equal(steps["next_state_desc"], steps["next_obs"])
    assert np.array_equal(steps["rewards"], steps["next_obs"])
    assert steps["actions"].tolist() == [1] * 5
    assert steps["dones"].tolist() == [0, 1, 0, 1, 0]
    assert not steps["truncations"].any()
    assert found.fitness == pytest.approx(2 * start + 3, rel=1e-6)


def test_transitions_need_a_state_descriptor() -> None:
    class Bare(line_env.Line):
        def reset(self, rng: jax.Array) -> State:
            return super().reset(rng).replace(info={})

    episode = Episode(Bare(), episode_length=2, transitions=True)
    with pytest.raises(
        ValueError, match="states with no state descriptor; allowed: QD"
    ):
        episode(jnp.ones((2, 1)), KEY)


def test_a_fault_may_be_a_python_number() -> None:
    env = EpisodeWrapper(PointMaze(), 5, 1)
    state = env.reset(jax.random.key(0))
    state = state.replace(info={**state.info, "fault": 0})
    assert env.step(state, jnp.zeros(2)).info["steps"] == 1
