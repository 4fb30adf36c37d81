"""Plans of actions: all steps in one call are the steps one by one."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contract import REPEATED

import newton_qd
from newton_qd import physics
from newton_qd.envs.rollouts import RolloutOrder, _order
from newton_qd.physics import row_calls
from newton_qd.robots import HOPPER
from newton_qd.wrappers import DescriptorWrapper, Wrapper

STEPS, WORLDS = 12, 5


def scanned(env: Any, state: Any, actions: jax.Array, params: Any = None) -> Any:
    """The states of a plan, step by step."""

    def advance(state: Any, action: jax.Array) -> tuple[Any, Any]:
        state = env.step(state, action, params)
        return state, state

    return jax.lax.scan(advance, state, actions)[1]


def plans(env: Any, seed: int = 0) -> jax.Array:
    """Actions (WORLDS, STEPS, nu); world 1 has an action that is no number."""
    shape = (WORLDS, STEPS, env.action_size)
    actions = jax.random.uniform(jax.random.key(seed), shape, env.dtype, -1, 1)
    return actions.at[1, 5, 0].set(jnp.nan)


def assert_same(a: Any, b: Any) -> None:
    """Bitwise, leaf by leaf."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def check(env: Any) -> None:
    """The states of plans are those of steps, with and without a fault."""
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), WORLDS))
    actions = plans(env)
    expected = jax.jit(jax.vmap(lambda s, a: scanned(env, s, a)))(states, actions)
    assert_same(jax.jit(jax.vmap(env.rollout))(states, actions), expected)


@pytest.mark.parametrize("name", ["hopper_uni"])
def test_states_are_those_of_steps(name: str) -> None:
    env = newton_qd.create(name, auto_reset=False, episode_length=7)
    assert _order(env) == RolloutOrder.IN_ORDER
    check(env)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted({*newton_qd.registered_envs()} - REPEATED))
def test_states_of_every_task_are_those_of_steps(name: str) -> None:
    check(newton_qd.create(name, auto_reset=False, episode_length=None))


def test_worlds_that_reset_themselves_step_one_by_one() -> None:
    env = newton_qd.create("hopper_uni", episode_length=4)
    assert _order(env) == RolloutOrder.ONE_BY_ONE
    check(env)
    options: Any = {"auto_reset": False, "action_repeat": 2}
    repeating = newton_qd.create("hopper_uni", episode_length=4, **options)
    assert _order(repeating) == RolloutOrder.ONE_BY_ONE


def test_a_batched_environment_rolls_out_each_world() -> None:
    env = newton_qd.create(
        "hopper_uni", batch_size=WORLDS, auto_reset=False, episode_length=None
    )
    state = jax.jit(env.reset)(jax.random.key(1))
    actions = jnp.swapaxes(plans(env), 0, 1)
    expected = jax.jit(lambda s, a: scanned(env, s, a))(state, actions)
    assert_same(jax.jit(env.rollout)(state, actions), expected)
    with pytest.raises(ValueError, match=r"actions: .* shape \(steps, 5, 3\)"):
        env.rollout(state, actions[:, :2])


@pytest.mark.parametrize("options", [{}, {"auto_reset": False, "eval_metrics": True}])
def test_wrappers_around_a_batch_roll_out_each_world(options: dict[str, Any]) -> None:
    env = newton_qd.create("pointmaze", batch_size=WORLDS, **options)
    state = jax.jit(env.reset)(jax.random.key(1))
    actions = jnp.swapaxes(plans(env), 0, 1)
    expected = jax.jit(lambda s, a: scanned(env, s, a))(state, actions)
    assert_same(jax.jit(env.rollout)(state, actions), expected)
    with pytest.raises(ValueError, match=r"actions: .* shape \(steps, 5, 2\)"):
        env.rollout(state, actions[:, 0])


class Doubled(Wrapper):
    """Doubles the action."""

    def step(self, state: Any, action: Any, params: Any = None) -> Any:
        return self.env.step(state, 2 * action, params)


class Height(DescriptorWrapper):
    """Height of the root."""

    limits: ClassVar = ((0.0,), (2.0,))

    def describe(self, state: Any) -> jax.Array:
        return state.pipeline_state.q[1:2]


class Highest(Height):
    """The highest root so far, which only the last state descriptor knows."""

    def describe(self, state: Any) -> jax.Array:
        old = state.info.get("state_descriptor")
        height = super().describe(state)
        return height if old is None else jnp.maximum(old, height)


class Said(Highest):
    """Reads the physics alone, and says so."""

    rollout_order = RolloutOrder.AT_ONCE

    def describe(self, state: Any) -> jax.Array:
        return state.pipeline_state.q[1:2]


class Shifted(Height):
    """Overrides ``step``, but not the order of its base class."""

    def step(self, state: Any, action: Any, params: Any = None) -> Any:
        return super().step(state, action + 1, params)


def test_a_class_that_steps_in_its_own_way_steps_one_by_one() -> None:
    env = newton_qd.create("hopper", auto_reset=False, episode_length=None)
    assert _order(env) == RolloutOrder.AT_ONCE
    for kind in (Doubled, Shifted):
        own = kind(env) if kind is Doubled else Shifted(env, "hopper")
        assert _order(own) == RolloutOrder.ONE_BY_ONE
        check(own)


def test_state_descriptors_are_written_in_order() -> None:
    env = newton_qd.create("hopper", auto_reset=False, episode_length=None)
    assert _order(Highest(env, "hopper")) == RolloutOrder.IN_ORDER
    check(Highest(env, "hopper"))
    for kind in (Said, type("Later", (Height,), {"rollout_order": Said.rollout_order})):
        assert _order(kind(env, "hopper")) == RolloutOrder.AT_ONCE
    for name in ("hopper_uni", "ant_omni"):
        own = newton_qd.create(name, auto_reset=False, episode_length=None)
        assert _order(own) == RolloutOrder.AT_ONCE


def test_views_of_brax_leave_the_order_as_it_is() -> None:
    options: Any = {"auto_reset": False, "brax_views": True}
    for length, order in ((None, RolloutOrder.AT_ONCE), (7, RolloutOrder.IN_ORDER)):
        env = newton_qd.create("hopper_uni", episode_length=length, **options)
        assert _order(env) == order
        check(env)


def test_wrong_actions_are_refused() -> None:
    env = newton_qd.create("hopper", auto_reset=False)
    state = env.reset(jax.random.key(0))
    for actions in (jnp.zeros(3), jnp.zeros((4, 2)), jnp.zeros((2, 4, 3))):
        with pytest.raises(ValueError, match="actions: got an array of shape"):
            env.rollout(state, actions)
    with pytest.raises(TypeError, match=r"^actions: got an array of int32; .*32"):
        env.rollout(state, jnp.zeros((2, 3), jnp.int32))


def test_float64_needs_the_mode_of_jax() -> None:
    """As in ``reset`` and ``step``. Before, the error was about ``controls``."""
    with jax.enable_x64(True):
        env = newton_qd.create("hopper", auto_reset=False, dtype="float64")
        state = jax.jit(env.reset)(jax.random.key(0))
    with pytest.raises(ValueError, match=r"^dtype: got 'float64' while JAX x64 is off"):
        env.rollout(state, jnp.zeros((2, 3)))


@pytest.mark.parametrize(
    ("native", "own"),
    [
        pytest.param(True, False, id="native-shared"),
        pytest.param(True, True, id="native-parameters", marks=pytest.mark.slow),
        pytest.param(False, False, id="scan-shared", marks=pytest.mark.slow),
        pytest.param(False, True, id="scan-parameters", marks=pytest.mark.slow),
    ],
)
def test_gradients_are_those_of_steps(
    x64: None, monkeypatch: pytest.MonkeyPatch, native: bool, own: bool
) -> None:
    system = physics.load_system(HOPPER, "float64")
    rng = np.random.default_rng(0)
    controls = jnp.asarray(rng.uniform(-1, 1, (3, STEPS, system.nu)))
    controls = controls.at[1, 8, 0].set(jnp.nan)
    weights = jnp.asarray(rng.normal(size=(STEPS, system.nq + system.nv)))
    params = physics.default_params(system)
    if not native:
        monkeypatch.setattr(row_calls, "native", lambda device: False)

    def value(one: bool, q: Any, controls: Any, params: Any) -> jax.Array:
        start = physics.initial_state(system, q, jnp.zeros(system.nv))
        if one:
            after = physics.rollout(system, start, controls, params).after
        else:

            def advance(carry: Any, control: Any) -> Any:
                state, bad = carry
                control = jnp.where(bad, jnp.full_like(control, jnp.nan), control)
                state, fault = physics.step(system, state, control, params)
                return (state, bad | (fault > 0)), state

            after = jax.lax.scan(advance, (start, jnp.zeros((), bool)), controls)[1]
        states = jnp.concatenate([after.q, after.v], axis=1)
        return (states * weights).sum() + after.normal_impulse.sum()

    arguments = (jnp.asarray(system.rest_q), controls, params if own else None)
    wanted = (1, 2, 3) if own else (1, 2)
    found, expected = (
        jax.jit(
            jax.vmap(jax.value_and_grad(value, wanted), (None, None, 0, None)),
            static_argnums=0,
        )(one, *arguments)
        for one in (True, False)
    )
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-12 * np.abs(y).max())
    assert not np.any(found[1][1][1, 8:]) and np.any(found[1][1][1, :8])


def test_an_empty_plan_has_no_states() -> None:
    env = newton_qd.create("hopper", auto_reset=False, episode_length=None)
    state = env.reset(jax.random.key(0))
    assert env.rollout(state, jnp.zeros((0, 3))).obs.shape == (0, 11)


@pytest.mark.parametrize("native", [False, True])
def test_a_world_at_fault_stays_at_fault(
    monkeypatch: pytest.MonkeyPatch, native: bool
) -> None:
    monkeypatch.setattr(row_calls, "native", lambda device: native)
    system = physics.load_system(HOPPER)
    q, v = jnp.asarray(system.rest_q, jnp.float32), jnp.zeros(system.nv)
    start = physics.initial_state(system, q, v)
    controls = jnp.zeros((3, system.nu)).at[1].set(jnp.nan)
    found = jax.jit(lambda u: physics.rollout(system, start, u))(controls)
    assert found.fault.tolist() == [0, 1, 1]
    np.testing.assert_array_equal(found.after.q[2], found.after.q[0])
