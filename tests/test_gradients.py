"""The adjoint is the derivative of the step, under every transformation of JAX."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics_helpers import (
    batched_step,
    directional_errors,
    functional,
    one_step,
    random_states,
    report,
)

import newton_qd
from newton_qd import physics
from newton_qd.envs.base import Env
from newton_qd.envs.state import State
from newton_qd.physics.system import System
from newton_qd.robots import ANT

WORLDS = 100


def ant(dtype: str = "float64") -> System:
    return physics.load_system(ANT, dtype)


@pytest.mark.parametrize(("steps", "bound"), [(1, 1e-6), (16, 1e-4)])
def test_directional_derivatives(x64: None, steps: int, bound: float) -> None:
    system = ant()
    inputs = random_states(system, np.random.default_rng(0), WORLDS)
    after = batched_step(system)(*inputs)
    pressed = np.asarray(after[3])[:, system.feet].max(axis=1) > 0
    assert pressed[: WORLDS // 2].all()
    assert not pressed.all()
    errors = directional_errors(functional(system, steps), inputs)
    report("largest error for q, v, control", errors.max(axis=1))
    assert errors.shape == (3, WORLDS)
    assert errors.max() < bound


def test_kinematics_gradient(x64: None) -> None:
    system = ant()
    q, v, _ = random_states(system, np.random.default_rng(0), 20)
    shape = jax.eval_shape(
        functools.partial(physics.forward_kinematics, system), q[0], v[0]
    )
    rng = np.random.default_rng(1)
    weights = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape), shape)

    def value(q: jax.Array, v: jax.Array) -> jax.Array:
        bodies = physics.forward_kinematics(system, q, v)
        terms = jax.tree.map(lambda w, x: (w * x).sum(), weights, bodies)
        return sum(jax.tree.leaves(terms), jnp.zeros(()))

    errors = directional_errors(value, (q, v))
    report("largest error for q, v", errors.max(axis=1))
    assert errors.max() < 1e-8


REWARD_STEPS = 8


def reward_gradient(env: Env) -> Callable[[State, jax.Array], jax.Array]:
    """Gradients (n, steps, nu) of a sum of rewards with respect to the actions."""

    def total(actions: jax.Array, state: State) -> jax.Array:
        def advance(state: State, action: jax.Array) -> tuple[State, jax.Array]:
            state = env.step(state, action)
            return state, state.reward

        return jax.lax.scan(advance, state, actions)[1].sum()

    compiled = jax.jit(jax.vmap(jax.grad(total)))
    return lambda state, actions: compiled(actions, state)


def single(tree: Any) -> Any:
    """Rounds float64 leaves to float32."""
    wide = np.float64
    return jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == wide else x, tree)


@pytest.mark.slow
def test_single_precision(x64: None) -> None:
    """The float32 gradient of a reward sum points where the float64 one does."""
    envs = {
        dtype: newton_qd.create("ant_uni", auto_reset=False, dtype=dtype)
        for dtype in ("float32", "float64")
    }
    rng = np.random.default_rng(0)
    q, v, _ = random_states(ant(), rng, WORLDS)
    still = functools.partial(physics.initial_state, ant())
    keys = jax.random.split(jax.random.key(0), WORLDS)
    state = jax.jit(jax.vmap(envs["float64"].reset))(keys)
    start = jax.vmap(still)(jnp.asarray(q), jnp.asarray(v))
    state = state.replace(pipeline_state=start)
    actions = jnp.asarray(rng.uniform(-1.0, 1.0, (WORLDS, REWARD_STEPS, 8)))
    exact = np.asarray(reward_gradient(envs["float64"])(state, actions))
    rounded = reward_gradient(envs["float32"])(single(state), single(actions))
    assert rounded.dtype == np.float32
    a = exact.reshape(WORLDS, -1)
    b = np.asarray(rounded, np.float64).reshape(WORLDS, -1)
    cosine = (a * b).sum(1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
    report("smallest cosine", cosine.min())
    assert (np.linalg.norm(a, axis=1) > 0).all()
    assert (cosine > 0.999).sum() >= 95


def flat_functional() -> tuple[Callable[..., jax.Array], tuple[np.ndarray, ...]]:
    system = ant("float32")
    q, v, control = random_states(system, np.random.default_rng(3), 8)
    states = tuple(x.astype(np.float32) for x in (q, v, control))
    step = one_step(system)

    def value(q: jax.Array, v: jax.Array, control: jax.Array) -> jax.Array:
        q, v, impulse, normal, _ = step(q, v, control)
        return (q**2).sum() + v.sum() + impulse.sum() + (normal**2).sum()

    return value, states


def same(ours: Any, theirs: Any) -> None:
    """Equal up to the rounding of sums that XLA orders as it likes."""
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        a, b = np.asarray(a), np.asarray(b)
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5 * np.abs(b).max())


@pytest.mark.optimized
def test_gradient_and_vmap_commute() -> None:
    value, states = flat_functional()
    gradient = jax.grad(value, argnums=(0, 1, 2))
    inner = jax.jit(jax.vmap(gradient))(*states)
    batch = jax.vmap(value)
    outer = jax.jit(jax.grad(lambda *x: batch(*x).sum(), argnums=(0, 1, 2)))(*states)
    same(outer, inner)
    assert all(np.any(x) for x in inner)
    pairs = tuple(x.reshape(2, 4, -1) for x in states)
    nested = jax.jit(jax.vmap(jax.vmap(gradient)))(*pairs)
    same([x.reshape(8, -1) for x in nested], inner)
    alone = [jax.jit(gradient)(*(x[i] for x in states)) for i in range(2)]
    same([jnp.stack(rows) for rows in zip(*alone, strict=True)], [x[:2] for x in inner])
    # one control for all worlds: its gradient is the sum
    several = jax.vmap(value, (0, 0, None))
    shared = jax.jit(jax.grad(lambda u: several(*states[:2], u).sum()))
    each = jax.jit(jax.vmap(jax.grad(value, argnums=2), (0, 0, None)))
    control = states[2][0]
    same(shared(control), each(*states[:2], control).sum(axis=0))


def test_jacobian_has_the_rows_of_gradients() -> None:
    _, states = flat_functional()
    step = one_step(ant("float32"))

    def velocity(control: jax.Array) -> jax.Array:
        return step(states[0][0], states[1][0], control)[1]

    control = states[2][0]
    jacobian = jax.jit(jax.jacrev(velocity))(control)
    assert jacobian.shape == (14, 8)
    for row in (0, 5, 13):
        one = jax.jit(jax.grad(lambda u, row=row: velocity(u)[row]))
        same(one(control), jacobian[row])


@pytest.mark.optimized
def test_scan_checkpoint_and_unrolled_loop_agree() -> None:
    _, states = flat_functional()
    step = one_step(ant("float32"))
    q, v, control = (x[0] for x in states)
    controls = jnp.stack([control, -control, 0.5 * control])

    def advance(state: Any, control: jax.Array) -> Any:
        q, v, _, normal, _ = step(*state, control)
        return (q, v), normal.sum()

    def scanned(controls: jax.Array, body: Any = advance) -> jax.Array:
        (_, v), normal = jax.lax.scan(body, (q, v0), controls)
        return v.sum() + normal.sum()

    def unrolled(controls: jax.Array) -> jax.Array:
        state, total = (q, v0), jnp.zeros((), np.float32)
        for control in controls:
            state, normal = advance(state, control)
            total += normal
        return state[1].sum() + total

    v0 = jnp.asarray(v)
    kept = jax.jit(jax.grad(scanned))(controls)
    again = jax.grad(lambda u: scanned(u, jax.checkpoint(advance)))
    same(jax.jit(again)(controls), kept)
    same(jax.jit(jax.grad(unrolled))(controls), kept)
    assert np.abs(np.asarray(kept)).max() > 0


@pytest.mark.optimized
def test_value_with_gradient_is_the_value_without() -> None:
    _, states = flat_functional()
    step = batched_step(ant("float32"))
    plain = jax.jit(step)(*states)
    recorded = jax.jit(lambda *x: jax.vjp(step, *x)[0])(*states)
    for a, b in zip(plain, recorded, strict=True):
        np.testing.assert_array_equal(a, b)


def test_forward_mode_and_second_derivatives_raise() -> None:
    value, states = flat_functional()
    one = tuple(jnp.asarray(x[0]) for x in states)
    with pytest.raises(TypeError, match="forward-mode"):
        jax.jvp(value, one, one)
    with pytest.raises(TypeError, match="forward-mode"):
        jax.jacfwd(value, argnums=2)(*one)
    gradient = jax.grad(value, argnums=2)
    with pytest.raises(TypeError, match="cannot be differentiated"):
        jax.grad(lambda u: gradient(*one[:2], u).sum())(one[2])


def spoilt(states: tuple[np.ndarray, ...], number: float, i: int) -> list[np.ndarray]:
    """The states with one entry of input ``i`` of world 3 replaced."""
    inputs = [x.copy() for x in states]
    inputs[i][3, -1] = number
    return inputs


@pytest.mark.parametrize(
    ("number", "i"),
    [(np.nan, 0), (np.inf, 1), (1e30, 1), (-np.inf, 2), (np.nan, 2)],
    ids=["q nan", "v inf", "v overflows", "control inf", "control nan"],
)
def test_fault_has_no_gradient(
    monkeypatch: pytest.MonkeyPatch, number: float, i: int
) -> None:
    """Exactly zero in its own world, and bitwise nothing in the others."""
    monkeypatch.setenv("NEWTON_QD_LANES", "1")  # the deterministic mode of a GPU
    value, states = flat_functional()
    system = ant("float32")
    step = batched_step(system)
    gradient = jax.jit(jax.vmap(jax.grad(value, argnums=(0, 1, 2))))
    others = np.arange(8) != 3
    inputs = spoilt(states, number, i)
    outputs = [np.asarray(x) for x in step(*inputs)]
    np.testing.assert_array_equal(outputs[4], (~others).astype(np.int32))
    # it stays where it was, or in the default pose if it was nowhere
    stay = np.isfinite(number) or i == 2
    q = inputs[0][3] if stay else system.rest_q.astype(np.float32)
    v = inputs[1][3] if stay else np.zeros(system.nv, np.float32)
    np.testing.assert_array_equal(outputs[0][3], q)
    np.testing.assert_array_equal(outputs[1][3], v)
    assert not outputs[2][3].any()
    assert not outputs[3][3].any()
    for a, b in zip(outputs, step(*states), strict=True):
        np.testing.assert_array_equal(a[others], np.asarray(b)[others])
    for a, b in zip(gradient(*inputs), gradient(*states), strict=True):
        a, b = np.asarray(a), np.asarray(b)
        assert not a[3].any()
        assert np.abs(b[3]).max() > 0
        np.testing.assert_array_equal(a[others], b[others])
