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

import newton_qd
from newton_qd.envs.base import Env, PhysicsEnv, State
from newton_qd.types import INFO_KEYS

NAMES = newton_qd.registered_envs()
STACKS: dict[str, dict[str, Any]] = {
    "default": {},
    "bare": {"episode_length": None, "auto_reset": False},
    "repeat": {"action_repeat": 2},
    "fixed": {"fixed_init_state": True},
    "batch": {"batch_size": 3},
    "eval": {"batch_size": 3, "eval_metrics": True},
    "all": {
        "episode_length": 3,
        "action_repeat": 2,
        "batch_size": 3,
        "eval_metrics": True,
        "fixed_init_state": True,
    },
}


@functools.cache
def make(name: str, stack: str = "default") -> Env:
    return newton_qd.create(name, **STACKS[stack])


@functools.cache
def rollout(env: Env) -> Any:
    """Jitted function of one state and actions (t, nu): the states it went through."""

    def run(state: State, actions: jax.Array) -> State:
        def advance(state: State, action: jax.Array) -> tuple[State, State]:
            state = env.step(state, action)
            return state, state

        return jax.lax.scan(advance, state, actions)[1]

    return jax.jit(jax.vmap(run))


def keys(count: int, seed: int = 0) -> jax.Array:
    return jax.random.split(jax.random.key(seed), count)


def random_actions(env: Env, shape: tuple[int, ...], seed: int = 0) -> jax.Array:
    shape = (*shape, env.action_size)
    return jax.random.uniform(jax.random.key(seed), shape, env.dtype, -1.0, 1.0)


def worlds(env: Env, count: int) -> State:
    return jax.jit(jax.vmap(env.reset))(keys(count))


def zero_action(env: Env, state: State) -> jax.Array:
    return jnp.zeros((*state.done.shape, env.action_size), env.dtype)


def same(a: Any, b: Any) -> bool:
    """Whether two pytrees are equal bit by bit."""
    equal = jax.tree.map(
        lambda x, y: np.asarray(x).tobytes() == np.asarray(y).tobytes(), a, b
    )
    return all(jax.tree.leaves(equal))


def outline(tree: Any) -> Any:
    return [(x.shape, x.dtype, x.weak_type) for x in jax.tree.leaves(tree)]


def row(tree: Any, index: Any) -> Any:
    return jax.tree.map(lambda x: np.asarray(x)[index], tree)


def reshaped(tree: Any, old_axes: int, new: tuple[int, ...]) -> Any:
    return jax.tree.map(
        lambda x: np.asarray(x).reshape(*new, *x.shape[old_axes:]), tree
    )


@pytest.mark.parametrize("name", NAMES)
def test_sizes_are_as_declared(name: str) -> None:
    env = make(name)
    first = jax.jit(env.reset)(jax.random.key(1))
    for state in (first, jax.jit(env.step)(first, zero_action(env, first))):
        assert state.obs.shape == (env.observation_size,)
        assert state.reward.shape == state.done.shape == ()
        assert state.obs.dtype == state.reward.dtype == state.done.dtype == env.dtype
        assert set(state.info) <= set(INFO_KEYS)
        assert np.all(np.isfinite(state.obs))
    robot = env.unwrapped
    assert env.dt == robot.dt > 0
    if isinstance(robot, PhysicsEnv):
        assert sum(size for _, size in robot.observation_layout) == env.observation_size
        assert env.action_size == robot.system.nu


@pytest.mark.parametrize("name", NAMES)
def test_descriptors_are_as_declared(name: str) -> None:
    env: Any = make(name)
    state = jax.jit(env.reset)(jax.random.key(1))
    if name not in newton_qd.descriptor_extractor:
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


@pytest.mark.parametrize("name", NAMES)
def test_reset_takes_both_kinds_of_key(name: str) -> None:
    env = make(name)
    reset = jax.jit(env.reset)
    typed = reset(jax.random.key(3))
    assert same(typed, reset(rng=jax.random.key(3)))
    assert same(typed, reset(jax.random.PRNGKey(3)))
    assert not same(typed.obs, reset(jax.random.key(4)).obs)


@pytest.mark.parametrize("stack", STACKS)
@pytest.mark.parametrize("name", NAMES)
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
@pytest.mark.parametrize("name", NAMES)
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


@pytest.mark.parametrize("name", NAMES)
def test_x64_changes_no_value(name: str, x64: None) -> None:
    env = make(name)
    state = jax.jit(env.reset)(jax.random.key(0))
    wide = jax.jit(env.step)(state, jnp.full((env.action_size,), 0.3, np.float32))
    with jax.enable_x64(False):
        state = jax.jit(env.reset)(jax.random.key(0))
        narrow = jax.jit(env.step)(state, jnp.full((env.action_size,), 0.3))
    assert same(wide, narrow)


@pytest.mark.parametrize("name", NAMES)
def test_float64_environment(name: str, x64: None) -> None:
    env = newton_qd.create(name, dtype="float64")
    state = jax.jit(env.step)(
        jax.jit(env.reset)(jax.random.key(0)), jnp.zeros(env.action_size, np.float64)
    )
    floats = [
        x for x in jax.tree.leaves(state) if jnp.issubdtype(x.dtype, jnp.floating)
    ]
    assert all(leaf.dtype == np.float64 for leaf in floats)
    assert state.info["fault"].dtype == np.int32
    with jax.enable_x64(False), pytest.raises(ValueError, match=r"float64.*x64"):
        env.reset(jax.random.key(0))


@pytest.mark.parametrize("name", NAMES)
def test_step_is_pure(name: str) -> None:
    # not jitted: a traced dictionary is a copy, so that no change would show
    env = make(name, "eval")
    state = jax.jit(env.reset)(jax.random.key(0))
    before = jax.tree.map(np.array, state)
    action = random_actions(env, (3,))
    first, second = env.step(state, action), env.step(state, action)
    assert jax.tree.structure(before) == jax.tree.structure(state)
    assert same(before, state)
    assert same(first, second)


@pytest.mark.parametrize("name", NAMES)
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


@pytest.mark.parametrize("name", NAMES)
def test_reset_does_not_depend_on_the_batch(name: str) -> None:
    env = make(name)
    batch = worlds(env, 64)
    assert same(jax.jit(env.reset)(keys(64)[5]), row(batch, 5))


@pytest.mark.parametrize("name", NAMES)
def test_population_axis(name: str) -> None:
    env = make(name)
    state, actions = worlds(env, 6), random_actions(env, (6, 3))
    flat = rollout(env)(state, actions)
    folded = reshaped((state, actions), 1, (2, 3))
    nested = jax.jit(jax.vmap(rollout(env)))(*folded)
    assert same(reshaped(nested, 2, (6,)), flat)


@pytest.mark.parametrize("name", NAMES)
def test_batched_environment_under_a_population(name: str) -> None:
    env = make(name, "eval")
    population = jax.jit(jax.vmap(env.reset))(keys(2))
    action = zero_action(env, population)
    stepped = jax.jit(jax.vmap(env.step))(population, action)
    step = jax.jit(env.step)
    for index in range(2):
        assert same(step(*row((population, action), index)), row(stepped, index))


@pytest.mark.parametrize("name", NAMES)
def test_environment_is_a_static_argument(name: str) -> None:
    env = make(name)
    assert env == env and hash(env) == hash(env)
    assert env != newton_qd.create(name)

    @functools.partial(jax.jit, static_argnames="env")
    def play(state: State, env: Env) -> State:
        return env.step(state, jnp.zeros((env.action_size,), env.dtype))

    state = play(jax.jit(env.reset)(jax.random.key(0)), env=env)
    play(state, env=env)
    assert play._cache_size() == 1


@pytest.mark.parametrize("name", NAMES)
def test_every_observation_element_moves(name: str) -> None:
    env = make(name, "bare")
    robot = env.unwrapped
    assert isinstance(robot, PhysicsEnv)
    # strong actions throw the robot about, so that every contact sphere is used
    actions = 4.0 * random_actions(env, (64, 60))
    observed = np.asarray(rollout(env)(worlds(env, 64), actions).obs)
    still = np.ptp(observed.reshape(-1, env.observation_size), axis=0) == 0
    start = 0
    for block, size in robot.observation_layout:
        found = still[start : start + size]
        if block.startswith("contact"):
            found = found.reshape(-1, 3) & ~contact_never_moves(robot, block)
        assert not np.any(found), (block, found)
        start += size


def contact_never_moves(env: PhysicsEnv, block: str) -> np.ndarray:
    """Entries (bodies and ground, 3) that no contact can change."""
    system = env.system
    never = np.ones((system.nb + 1, 3), bool)
    for body, centre in zip(system.contact_body, system.contact_position, strict=True):
        never[body] = False
        # a sphere around the centre of mass is touched straight below it: no yaw
        central = np.allclose(centre, system.com[body], atol=1e-12)
        never[body, 2] = central and "angular" in block
    return never


@pytest.mark.parametrize("name", NAMES)
def test_gradient_of_a_return(name: str) -> None:
    env = make(name, "bare")
    state = worlds(env, 4)

    def total(actions: jax.Array) -> jax.Array:
        return jnp.sum(rollout(env)(state, actions).reward)

    gradient = jax.jit(jax.grad(total))(0.1 * random_actions(env, (4, 4)))
    assert np.all(np.isfinite(gradient))
    assert np.all(np.any(np.asarray(gradient) != 0, axis=(1, 2)))


def spoil(state: State, actions: jax.Array, kind: str) -> tuple[State, jax.Array]:
    """World 1 of a batch meets a value that is not finite; actions are (n, t, nu)."""
    if kind == "state":
        physics = state.pipeline_state
        bad = state.replace(
            pipeline_state=type(physics)(
                physics.q.at[1, -1].set(jnp.nan),
                physics.v,
                physics.impulse,
                physics.normal_impulse,
            )
        )
        return bad, actions
    value = {"nan": jnp.nan, "inf": jnp.inf, "huge": 1e38}[kind]
    return state, actions.at[1, 2, 0].set(value)


@pytest.mark.parametrize("kind", ["nan", "inf", "huge", "state"])
@pytest.mark.parametrize("name", NAMES)
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
    assert np.all(physics.impulse[first:] == 0)
    assert np.all(physics.normal_impulse[first:] == 0)
    if first:
        assert same(row(physics.q, first), row(physics.q, first - 1))
        assert same(row(physics.v, first), row(physics.v, first - 1))
    assert same(row(faulty.obs, first), row(faulty.obs, 4))


@pytest.mark.parametrize("kind", ["nan", "huge", "state"])
@pytest.mark.parametrize("name", NAMES)
def test_no_gradient_passes_a_fault(name: str, kind: str) -> None:
    env = make(name, "bare")
    start, sound_actions = worlds(env, 4), 0.1 * random_actions(env, (4, 5))
    bad_start, bad_actions = spoil(start, sound_actions, kind)

    def total(q: jax.Array, actions: jax.Array, state: State) -> jax.Array:
        physics = state.pipeline_state
        physics = type(physics)(q, physics.v, physics.impulse, physics.normal_impulse)
        states = rollout(env)(state.replace(pipeline_state=physics), actions)
        parts = (states.reward, states.obs, states.pipeline_state, states.metrics)
        return sum((jnp.sum(jnp.sin(x)) for x in jax.tree.leaves(parts)), jnp.zeros(()))

    gradient = jax.jit(jax.grad(total, argnums=(0, 1)))
    sound = gradient(start.pipeline_state.q, sound_actions, start)
    bad = gradient(bad_start.pipeline_state.q, bad_actions, bad_start)
    others = np.array([0, 2, 3])
    assert same(row(bad, others), row(sound, others))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(bad))
    first = 0 if kind == "state" else 2
    assert np.all(bad[1][1, first:] == 0)
    if kind == "state":
        assert np.all(bad[0][1] == 0)
    else:
        assert np.any(bad[1][1, :first] != 0)


@pytest.mark.parametrize("name", NAMES)
def test_auto_reset_heals_a_fault(name: str) -> None:
    env = make(name, "batch")
    first = jax.jit(env.reset)(jax.random.key(0))
    step = jax.jit(env.step)
    actions = random_actions(env, (3,))
    broken = step(step(first, actions), actions.at[1].set(jnp.nan))
    assert broken.info["fault"].tolist() == [0, 1, 0]
    assert broken.info["steps"].tolist() == [2, 2, 2]
    with pytest.raises(newton_qd.FaultError, match="world 1 at step 2"):
        newton_qd.check(broken)
    assert same(row(broken.obs, 1), row(first.obs, 1))
    healed = step(broken, actions)
    newton_qd.check(healed)
    assert healed.info["steps"].tolist() == [3, 1, 3]
    assert same(row(healed.obs, 1), row(step(first, actions).obs, 1))


@pytest.mark.parametrize("name", NAMES)
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


@pytest.mark.parametrize("name", NAMES)
def test_bad_actions_are_named(name: str) -> None:
    env = make(name)
    state = jax.jit(env.reset)(jax.random.key(0))
    size = env.action_size
    for shape in ((size + 1,), (), (2, size)):
        with pytest.raises(ValueError, match=rf"action: shape .*\({size},\)"):
            jax.eval_shape(env.step, state, jnp.zeros(shape, env.dtype))
    for wrong in (jnp.zeros(size, jnp.int32), jnp.zeros(size, jnp.bfloat16)):
        with pytest.raises(TypeError, match=rf"dtype {wrong.dtype} .*float32"):
            env.step(state, wrong)
    with pytest.raises(TypeError, match="action: type list"):
        env.step(state, [0.0] * size)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"params=.*not available yet.*None"):
        env.step(state, jnp.zeros(size), params={"mass": jnp.ones(())})
    batched = make(name, "batch")
    states = jax.jit(batched.reset)(jax.random.key(0))
    with pytest.raises(
        ValueError, match=rf"action: shape \(2, {size}\).*\(3, {size}\)"
    ):
        batched.step(states, jnp.zeros((2, size)))
    with pytest.raises(ValueError, match=r"state: done has shape \(\)"):
        batched.step(state, jnp.zeros((3, size)))


@pytest.mark.parametrize("name", NAMES)
def test_actions_of_numpy_and_weak_types_are_taken(name: str) -> None:
    env = make(name)
    state = jax.jit(env.reset)(jax.random.key(0))
    strong = env.step(state, jnp.full((env.action_size,), 0.5, np.float32))
    assert same(strong, env.step(state, np.full(env.action_size, 0.5)))
    assert same(strong, env.step(state, jnp.full((env.action_size,), 0.5)))


@pytest.mark.parametrize("name", NAMES)
def test_float64_action_is_refused_by_float32(name: str, x64: None) -> None:
    env = make(name)
    state = jax.jit(env.reset)(jax.random.key(0))
    with pytest.raises(TypeError, match=r"float64 given; .*float32"):
        env.step(state, jnp.zeros(env.action_size, np.float64))


@pytest.mark.parametrize("name", NAMES)
def test_fixed_initial_state_has_no_noise(name: str) -> None:
    env = newton_qd.create(name, fixed_init_state=True, batch_size=2)
    reset = jax.jit(env.reset)
    state = reset(jax.random.key(0))
    assert same(state, reset(jax.random.key(1)))
    assert same(row(state, 0), row(state, 1))
    assert same(state.obs, state.info["first_obs"])
    robot = env.unwrapped
    assert isinstance(robot, PhysicsEnv)
    alone = jax.jit(robot.fixed_state)()
    assert same(row(state.obs, 0), alone.obs)
    assert np.all(state.pipeline_state.v == 0)
    noisy = newton_qd.create(name, reset_noise_scale=0.0)
    exact = jax.jit(noisy.reset)(jax.random.key(0)).obs
    np.testing.assert_allclose(exact, alone.obs, atol=1e-6)
