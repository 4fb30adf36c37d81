"""The contract of every registered environment, whatever its task.

A new environment is tested here without being named. Comparisons are bitwise where
the contract says so: batch size, population axes and repetition change nothing.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contract import (
    EVERY_NAME,
    STACKS,
    batched_reset,
    coordinates,
    gradient,
    keys,
    make,
    observation_layout,
    outline,
    random_actions,
    reset,
    reshaped,
    rollout,
    row,
    same,
    step,
    worlds,
    zero_action,
)

import newton_qd
from newton_qd.envs.base import Env, PhysicsEnv
from newton_qd.envs.state import State
from newton_qd.types import INFO_KEYS


@pytest.mark.parametrize("name", EVERY_NAME)
def test_sizes_are_as_declared(name: str) -> None:
    env = make(name)
    first = reset(env)(jax.random.key(1))
    for state in (first, step(env)(first, zero_action(env, first))):
        assert state.obs.shape == (env.observation_size,)
        assert state.reward.shape == state.done.shape == ()
        assert state.obs.dtype == state.reward.dtype == state.done.dtype == env.dtype
        assert set(state.info) <= set(INFO_KEYS)
        assert np.all(np.isfinite(state.obs))
    robot = env.unwrapped
    assert env.dt == robot.dt > 0
    assert sum(size for _, size in observation_layout(env)) == env.observation_size
    if isinstance(robot, PhysicsEnv):
        assert env.action_size == robot.system.nu


@pytest.mark.parametrize("name", EVERY_NAME)
def test_descriptors_are_as_declared(name: str) -> None:
    env: Any = make(name)
    state = reset(env)(jax.random.key(1))
    if name not in newton_qd.tables.descriptor_extractor:
        assert "state_descriptor" not in state.info
        assert not hasattr(env, "descriptor_length")
        return
    length = env.descriptor_length
    assert env.behavior_descriptor_length == env.state_descriptor_length == length
    assert isinstance(env.state_descriptor_name, str)
    for limits in (
        env.descriptor_limits,
        env.behavior_descriptor_limits,
        env.state_descriptor_limits,
    ):
        low, high = limits
        assert low.shape == high.shape == (length,)
        assert low.dtype == high.dtype == env.dtype
        assert np.all(low < high)
    assert state.info["state_descriptor"].shape == (length,)


@pytest.mark.parametrize("name", EVERY_NAME)
def test_reset_takes_both_kinds_of_key(name: str) -> None:
    env = make(name)
    typed = reset(env)(jax.random.key(3))
    assert same(typed, reset(env)(rng=jax.random.key(3)))
    assert same(typed, reset(env)(jax.random.PRNGKey(3)))
    assert not same(typed.obs, reset(env)(jax.random.key(4)).obs)


@pytest.mark.parametrize("stack", STACKS)
@pytest.mark.parametrize("name", EVERY_NAME)
def test_state_keeps_its_shape(name: str, stack: str) -> None:
    env = make(name, stack)
    first = jax.eval_shape(env.reset, jax.random.key(0))
    action = zero_action(env, first)
    second = jax.eval_shape(env.step, first, action)
    assert jax.tree.structure(first) == jax.tree.structure(second)
    assert outline(first) == outline(second)
    assert not any(leaf.weak_type for leaf in jax.tree.leaves(first))
    batch = STACKS[stack].get("batch_size")
    if batch:
        assert all(leaf.shape[:1] == (batch,) for leaf in jax.tree.leaves(first))


@pytest.mark.parametrize("stack", STACKS)
@pytest.mark.parametrize("name", EVERY_NAME)
def test_float32_stays_float32_under_x64(name: str, stack: str, x64: None) -> None:
    env = make(name, stack)
    assert env.dtype == np.float32
    first = jax.eval_shape(env.reset, jax.random.key(0))
    second = jax.eval_shape(env.step, first, zero_action(env, first))
    for state in (first, second):
        assert state.info["fault"].dtype == np.int32
        for leaf in jax.tree.leaves(
            state.replace(info={**state.info, "fault": first.done})
        ):
            assert leaf.dtype == np.float32
    assert outline(first) == outline(second)


@pytest.mark.optimized
@pytest.mark.parametrize("name", EVERY_NAME)
def test_x64_changes_no_value(name: str, x64: None) -> None:
    env = make(name)
    state = reset(env)(jax.random.key(0))
    wide = step(env)(state, jnp.full((env.action_size,), 0.3, np.float32))
    with jax.enable_x64(False):
        state = reset(env)(jax.random.key(0))
        narrow = step(env)(state, jnp.full((env.action_size,), 0.3))
    assert same(wide, narrow)


@pytest.mark.parametrize("name", EVERY_NAME)
def test_float64_environment(name: str, x64: None) -> None:
    env = newton_qd.create(name, dtype="float64")
    state = step(env)(
        reset(env)(jax.random.key(0)), jnp.zeros(env.action_size, np.float64)
    )
    floats = [
        x for x in jax.tree.leaves(state) if jnp.issubdtype(x.dtype, jnp.floating)
    ]
    assert all(leaf.dtype == np.float64 for leaf in floats)
    assert state.info["fault"].dtype == np.int32
    with jax.enable_x64(False), pytest.raises(ValueError, match=r"float64.*x64"):
        env.reset(jax.random.key(0))


@pytest.mark.parametrize("name", EVERY_NAME)
def test_step_is_pure(name: str) -> None:
    env = make(name, "eval")
    state = reset(env)(jax.random.key(0))
    before = jax.tree.map(np.array, state)
    action = random_actions(env, (3,))
    # no arguments: JAX would copy their dictionaries, so that no change would show
    first, second = jax.jit(lambda: [env.step(state, action) for _ in range(2)])()
    assert jax.tree.structure(before) == jax.tree.structure(state)
    assert same(before, state)
    assert same(first, second)


@pytest.mark.parametrize("name", EVERY_NAME)
def test_no_buffer_is_in_a_state_twice(name: str) -> None:
    # a state with one buffer twice cannot be donated to a jitted step; without jit, one
    # variable is one buffer
    program = jax.make_jaxpr(make(name, "eval").reset)(jax.random.key(0)).jaxpr
    leaves = [leaf for leaf in program.outvars if leaf.aval.size]
    assert len({id(leaf) for leaf in leaves}) == len(leaves)


@pytest.mark.optimized
@pytest.mark.parametrize("name", EVERY_NAME)
def test_repetition_and_batch_size_change_nothing(name: str) -> None:
    env = make(name)
    state, actions = worlds(env, 64), random_actions(env, (64, 12))
    batch = rollout(env)(state, actions)
    assert same(batch, rollout(env)(state, actions))
    assert np.all(np.isfinite(batch.obs))
    for world in (0, 37):
        one = slice(world, world + 1)
        alone = rollout(env)(row(state, one), row(actions, one))
        assert same(alone, row(batch, one))


@pytest.mark.optimized
@pytest.mark.parametrize("name", EVERY_NAME)
def test_reset_does_not_depend_on_the_batch(name: str) -> None:
    env = make(name)
    batch = worlds(env, 64)
    assert same(reset(env)(keys(64)[5]), row(batch, 5))


@pytest.mark.optimized
@pytest.mark.parametrize("name", EVERY_NAME)
def test_population_axis(name: str) -> None:
    env = make(name, "bare")
    state, actions = worlds(env, 4), random_actions(env, (4, 5))
    flat = rollout(env)(state, actions)
    folded = reshaped((state, actions), 1, (2, 2))
    nested = jax.jit(jax.vmap(rollout(env)))(*folded)
    assert same(reshaped(nested, 2, (4,)), flat)


@pytest.mark.optimized
@pytest.mark.parametrize("name", EVERY_NAME)
def test_batched_environment_under_a_population(name: str) -> None:
    env = make(name, "eval")
    population = batched_reset(env)(keys(2))
    action = zero_action(env, population)
    stepped = jax.jit(jax.vmap(env.step))(population, action)
    for index in range(2):
        assert same(step(env)(*row((population, action), index)), row(stepped, index))


@pytest.mark.parametrize("name", EVERY_NAME)
def test_environment_is_a_static_argument(name: str) -> None:
    env = make(name)
    assert env == env and hash(env) == hash(env)
    assert env != newton_qd.create(name)

    traced = []

    @functools.partial(jax.jit, static_argnames="env")
    def play(state: State, env: Env) -> State:
        traced.append(env)
        return env.step(state, jnp.zeros((env.action_size,), env.dtype))

    state = play(reset(env)(jax.random.key(0)), env=env)
    play(state, env=env)
    assert traced == [env]


@pytest.mark.parametrize("name", EVERY_NAME)
def test_every_observation_element_moves(name: str) -> None:
    env = make(name, "bare")
    robot = env.unwrapped
    layout = observation_layout(env)
    # strong actions throw the robot about, so that every contact sphere is used
    actions = 4.0 * random_actions(env, (64, 60))
    observed = np.asarray(rollout(env)(worlds(env, 64), actions).obs)
    still = np.ptp(observed.reshape(-1, env.observation_size), axis=0) == 0
    start = 0
    for block, size in layout:
        found = still[start : start + size]
        if block.startswith("contact"):
            assert isinstance(robot, PhysicsEnv)
            found = found.reshape(-1, 3) & ~contact_never_moves(robot, block)
        assert not np.any(found), (block, found)
        start += size


def contact_never_moves(env: PhysicsEnv, block: str) -> np.ndarray:
    """Entries (bodies with mass, ground and walls, 3) that no contact can change."""
    system = env.system
    row = np.cumsum(system.mass > 0) - 1
    still = 1 + len(system.scene_links)
    never = np.ones((np.count_nonzero(system.mass) + still, 3), bool)
    for body, centre in zip(system.contact_body, system.contact_position, strict=True):
        never[row[body]] = False
        # a sphere around the centre of mass is touched straight below it: no yaw
        central = np.allclose(centre, system.com[body], atol=1e-12)
        never[row[body], 2] = central and "angular" in block
    return never


@pytest.mark.parametrize("name", EVERY_NAME)
def test_gradient_is_finite_and_reaches_every_action(name: str) -> None:
    env = make(name, "bare")
    state = worlds(env, 4)
    actions = 0.1 * random_actions(env, (4, 5))
    found = gradient(env)(coordinates(state), actions, state)
    assert all(np.all(np.isfinite(leaf)) for leaf in found)
    assert np.all(np.asarray(found[1]) != 0)


@pytest.mark.parametrize("name", EVERY_NAME)
def test_fixed_initial_state_has_no_noise(name: str) -> None:
    env = newton_qd.create(name, fixed_init_state=True, batch_size=2)
    state = reset(env)(jax.random.key(0))
    assert same(state, reset(env)(jax.random.key(1)))
    assert same(row(state, 0), row(state, 1))
    assert same(state.obs, state.info["first_obs"])
    inside: Any = make(name, "bare")
    alone = jax.jit(inside.fixed_state)()
    assert same(row(state.obs, 0), alone.obs)
    if not isinstance(env.unwrapped, PhysicsEnv):
        return
    assert np.all(state.pipeline_state.v == 0)
    noisy = newton_qd.create(name, reset_noise_scale=0.0)
    exact = reset(noisy)(jax.random.key(0)).obs
    np.testing.assert_allclose(exact, alone.obs, atol=1e-6)
