"""Faults stay in their world, and wrong input is named, in every environment."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contract import (
    EVERY_NAME,
    NAMES,
    coordinates,
    gradient,
    make,
    named,
    random_actions,
    reset,
    rollout,
    row,
    same,
    step,
    with_coordinates,
    worlds,
)

import newton_qd
from newton_qd.envs.base import Env
from newton_qd.envs.state import State
from newton_qd.physics.system import PhysicsState


def spoil(state: State, actions: jax.Array, kind: str) -> tuple[State, jax.Array]:
    """World 1 of a batch meets a value that is not finite; actions are (n, t, nu)."""
    if kind == "state":
        q = coordinates(state).at[1, -1].set(jnp.nan)
        return with_coordinates(state, q), actions
    value = {"nan": jnp.nan, "inf": jnp.inf, "huge": 3e38}[kind]
    return state, actions.at[1, 2, 0].set(value)


KINDS = [
    named(name, kind)
    for name in NAMES
    for kind in ("nan", "inf", "huge", "state")
    # actions that are clipped: a huge one is sound
    if kind != "huge" or name not in ("pointmaze", "quadruped_uni")
]


@pytest.mark.parametrize(("name", "kind"), KINDS)
def test_a_fault_stays_in_its_world(name: str, kind: str) -> None:
    env = make(name, "bare")
    state, actions = worlds(env, 4), random_actions(env, (4, 5))
    sound = rollout(env)(state, actions)
    bad_state, bad_actions = spoil(state, actions, kind)
    states = rollout(env)(bad_state, bad_actions)
    others = np.array([0, 2, 3])
    assert same(row(states, others), row(sound, others))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(states))
    first = 0 if kind == "state" else 2
    faulty = row(states, 1)
    assert faulty.info["fault"].tolist() == [0] * first + [1] * (5 - first)
    assert np.all(faulty.reward[first:] == 0) and np.all(faulty.done[first:] == 1)
    for value in faulty.metrics.values():
        assert np.all(value[first:] == 0)
    physics = faulty.pipeline_state
    if isinstance(physics, PhysicsState):
        assert np.all(physics.impulse[first:] == 0)
        assert np.all(physics.normal_impulse[first:] == 0)
    if first:
        assert same(
            row(coordinates(faulty), first), row(coordinates(faulty), first - 1)
        )
    if first and isinstance(physics, PhysicsState):
        assert same(row(physics.v, first), row(physics.v, first - 1))
    assert same(row(faulty.obs, first), row(faulty.obs, 4))


@pytest.mark.parametrize(("name", "kind"), KINDS)
def test_no_gradient_passes_a_fault(name: str, kind: str) -> None:
    env = make(name, "bare")
    start, sound_actions = worlds(env, 4), 0.1 * random_actions(env, (4, 5))
    bad_start, bad_actions = spoil(start, sound_actions, kind)

    sound = gradient(env)(coordinates(start), sound_actions, start)
    bad = gradient(env)(coordinates(bad_start), bad_actions, bad_start)
    others = np.array([0, 2, 3])
    assert same(row(bad, others), row(sound, others))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(bad))
    first = 0 if kind == "state" else 2
    to_start, to_actions = row(bad, 1)
    assert np.all(to_actions[first:] == 0)
    if kind == "state":
        assert np.all(to_start == 0)
    else:
        assert np.any(to_actions[:first] != 0)


@pytest.mark.parametrize("name", EVERY_NAME)
def test_auto_reset_heals_a_fault(name: str) -> None:
    env = make(name, "batch")
    first = reset(env)(jax.random.key(0))
    actions = random_actions(env, (3,))
    broken = step(env)(step(env)(first, actions), actions.at[1].set(jnp.nan))
    assert broken.info["fault"].tolist() == [0, 1, 0]
    assert broken.info["steps"].tolist() == [2, 2, 2]
    with pytest.raises(newton_qd.FaultError, match="world 1 at step 2"):
        newton_qd.check(broken)
    assert same(row(broken.obs, 1), row(first.obs, 1))
    healed = step(env)(broken, actions)
    newton_qd.check(healed)
    assert healed.info["steps"].tolist() == [3, 1, 3]
    assert same(row(healed.obs, 1), row(step(env)(first, actions).obs, 1))


@pytest.mark.parametrize("name", EVERY_NAME)
def test_check_names_worlds(name: str) -> None:
    env = make(name, "bare")
    state = worlds(env, 4)
    newton_qd.check(state)
    bad, _ = spoil(state, random_actions(env, (4, 3)), "state")
    with pytest.raises(newton_qd.FaultError, match=r"world 1;") as caught:
        newton_qd.check(bad)
    assert isinstance(caught.value, FloatingPointError)
    with pytest.raises(TypeError, match="traced"):
        jax.eval_shape(newton_qd.check, state)
    for value in (2.0, jnp.nan):  # an environment of a user may say so
        odd = state.replace(done=state.done.at[3].set(value))
        with pytest.raises(newton_qd.FaultError, match="done neither 0 nor 1: world 3"):
            newton_qd.check(odd)


@pytest.mark.parametrize("name", EVERY_NAME)
def test_bad_actions_are_named(name: str) -> None:
    env = make(name)
    state = reset(env)(jax.random.key(0))
    size = env.action_size
    for shape in ((size + 1,), (), (2, size)):
        with pytest.raises(ValueError, match=rf"action: got .*shape .*\({size},\)"):
            jax.eval_shape(env.step, state, jnp.zeros(shape, env.dtype))
    for wrong in (jnp.zeros(size, jnp.int32), jnp.zeros(size, jnp.bfloat16)):
        with pytest.raises(TypeError, match=rf"got .*{wrong.dtype}; .*float32"):
            env.step(state, wrong)
    with pytest.raises(TypeError, match=r"action: got \[0"):
        env.step(state, [0.0] * size)  # pyright: ignore[reportArgumentType]
    with pytest.raises((TypeError, ValueError), match=r"params: got {.*allowed: None"):
        env.step(state, jnp.zeros(size), params={"mass": jnp.ones(())})
    batched = make(name, "batch")
    states = reset(batched)(jax.random.key(0))
    with pytest.raises(
        ValueError, match=rf"action: got .*\(2, {size}\).*\(3, {size}\)"
    ):
        batched.step(states, jnp.zeros((2, size)))
    with pytest.raises(ValueError, match=r"state: shape of done: got \(\)"):
        batched.step(state, jnp.zeros((3, size)))


@pytest.mark.parametrize("name", ("ant_uni", "pointmaze"))
def test_bad_states_are_named(name: str) -> None:
    env, action = make(name), jnp.zeros(make(name).action_size)
    state = reset(env)(jax.random.key(0))
    wrappers: Env = env
    while wrappers is not env.unwrapped:
        with pytest.raises(TypeError, match=r"state: got an array .*allowed: a State"):
            wrappers.step(action, state)  # pyright: ignore[reportArgumentType]
        wrappers = wrappers.env  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(ValueError, match=r"state: got info without 'fault'; allowed"):
        env.unwrapped.step(state.replace(info=None), action)  # pyright: ignore
    with pytest.raises(TypeError, match=r"state: got None; allowed: a State"):
        env.unwrapped.step(None, action)  # pyright: ignore[reportArgumentType]
    inside = reset(env.unwrapped)(jax.random.key(0))
    with pytest.raises(ValueError, match=r"state: got info without 'first_obs'; allow"):
        env.step(inside, action)
    with pytest.raises(ValueError, match=r"state: got info without 'steps'; allowed"):
        newton_qd.create(name, auto_reset=False).step(inside, action)


OTHERS = [
    ("hopper", "hopper_uni", "info without 'state_descriptor'"),
    ("ant_omni", "ant_uni", r"a state descriptor of shape \(2,\); .* shape \(4,\)"),
    ("hopper_uni", "walker2d_uni", "a state descriptor of shape"),
    ("halfcheetah_uni", "walker2d_uni", "metrics without 'reward_forward'; .*'walker"),
    ("hopper", "walker2d", r"coordinates and velocities of shape \(6,\) and \(6,\);"),
    ("pointmaze", "ant_omni", "a pipeline_state of type tuple; .* 'ant'"),
    ("ant_omni", "pointmaze", r"obs of shape \(87,\); .* shape \(2,\)"),
]


@pytest.mark.parametrize(("other", "name", "words"), OTHERS)
def test_states_of_another_environment_are_named(
    other: str, name: str, words: str
) -> None:
    envs = [newton_qd.create(each, auto_reset=False) for each in (other, name)]
    state = jax.eval_shape(envs[0].reset, jax.random.key(0))
    action = jnp.zeros(envs[1].action_size)
    with pytest.raises(ValueError, match=f"^state: got {words}"):
        jax.eval_shape(envs[1].step, state, action)
    own = jax.eval_shape(envs[1].reset, jax.random.key(0))
    jax.eval_shape(envs[1].step, own, action)
    jax.eval_shape(envs[1].step, own.replace(metrics={}), action)


@pytest.mark.parametrize("name", ("ant_uni", "pointmaze"))
def test_wrong_keys_are_named(name: str) -> None:
    for env in (make(name), make(name, "batch")):
        with pytest.raises(
            ValueError, match=r"^rng: got an array .*; allowed: one key"
        ):
            env.reset(jnp.array([1, 2, 3], jnp.uint32))
        for wrong in (0, None, jnp.zeros(2), np.zeros(2, np.int64)):
            with pytest.raises(
                TypeError, match=r"^rng: got .*; allowed: one key, such"
            ):
                env.reset(wrong)  # pyright: ignore[reportArgumentType]
        for kind in (jax.random.key, jax.random.PRNGKey):
            with pytest.raises(ValueError, match=r"^rng: got an array .*use jax\.vmap"):
                env.reset(jax.random.split(kind(0), 3))
            jax.eval_shape(env.reset, kind(0))
    with pytest.raises(TypeError, match=r"^key: got 3; allowed: one key"):
        newton_qd.randomize_params(3, make("ant_uni"))  # pyright: ignore


def test_check_of_no_state_is_named() -> None:
    wrong: Any
    for wrong in (3, None, {"info": 3}):
        with pytest.raises(
            TypeError, match=r"^state: got .*; allowed: a State that re"
        ):
            newton_qd.check(wrong)
    state = jax.eval_shape(make("pointmaze").reset, jax.random.key(0))
    with pytest.raises(ValueError, match=r"^state: got info without 'fault'; allowed"):
        newton_qd.check(state.replace(info={}))


@pytest.mark.parametrize("name", EVERY_NAME)
def test_actions_of_numpy_and_weak_types_are_taken(name: str) -> None:
    env = make(name)
    state = reset(env)(jax.random.key(0))
    array: Any = np.full(env.action_size, 0.5)
    actions = (array.astype(np.float32), array, jnp.full((env.action_size,), 0.5))
    # no arguments: JAX would make float32 of them before the step
    strong, *others = jax.jit(lambda: [env.step(state, x) for x in actions])()
    assert all(same(strong, other) for other in others)


@pytest.mark.parametrize("batch_size", [None, 3])
def test_a_wrong_dtype_in_a_batch_names_no_shape_of_one_world(
    batch_size: int | None,
) -> None:
    env = newton_qd.create("pointmaze", batch_size=batch_size)
    key, step = jax.random.key(0), env.step
    state = env.reset(key)
    if batch_size is None:
        state, step = jax.vmap(env.reset)(jax.random.split(key, 3)), jax.vmap(step)
    words = r"^action: got an array of int32; allowed: an array of float32\b"
    for call in (step, jax.jit(step)):
        with pytest.raises(TypeError, match=words):
            call(state, jnp.zeros((3, 2), jnp.int32))


@pytest.mark.parametrize("name", EVERY_NAME)
def test_float64_action_is_refused_by_float32(name: str, x64: None) -> None:
    env = make(name)
    state = reset(env)(jax.random.key(0))
    with pytest.raises(TypeError, match=r"got .*float64; .*float32"):
        env.step(state, jnp.zeros(env.action_size, np.float64))
