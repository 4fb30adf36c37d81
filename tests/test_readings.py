"""What a step reads from the state that it returns: bodies, torso, feet."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics_helpers import directional_errors, random_states, report

from newton_qd import physics
from newton_qd.physics.system import PhysicsState, System
from newton_qd.robots import ANT, HALFCHEETAH, HUMANOID, RobotSpec

WIDTH = 0.05


@functools.cache
def system_of(robot: RobotSpec) -> System:
    """Ant and humanoid report their bodies; the cheetah's torso hangs on slides."""
    reports = robot is not HALFCHEETAH
    return physics.load_system(
        robot, "float64", feet_width=WIDTH, reports_bodies=reports
    )


@functools.cache
def step_of(system: System) -> Any:
    """The jitted step of a batch of worlds: state and fault."""

    def step(q: jax.Array, v: jax.Array, control: jax.Array) -> Any:
        start = physics.initial_state(system, q, v)
        return physics.step(system, start, control)

    return jax.jit(jax.vmap(step))


def seen(system: System, state: PhysicsState) -> Any:
    """Bodies of a batch of states, by the kernel of the kinematics."""
    read = functools.partial(physics.forward_kinematics, system)
    return jax.jit(jax.vmap(read))(state.q, state.v)


@pytest.mark.parametrize("robot", [ANT, HALFCHEETAH, HUMANOID], ids=lambda r: r.name)
def test_step_and_kinematics_read_the_same(x64: None, robot: RobotSpec) -> None:
    system = system_of(robot)
    inputs = random_states(system, np.random.default_rng(0), 16)
    # of two worlds at fault one is frozen where it was, the other one is lost
    inputs[2][0] = np.nan
    inputs[1][1] = np.inf
    state, fault = step_of(system)(*inputs)
    assert fault.tolist() == [1, 1] + 14 * [0]
    bodies = seen(system, state)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state))
    np.testing.assert_array_equal(state.torso_xy, bodies.position[:, system.torso, :2])
    if system.reports_bodies:
        jax.tree.map(np.testing.assert_array_equal, state.bodies, bodies)
    else:
        assert state.bodies is None
    begin = jax.jit(jax.vmap(functools.partial(physics.initial_state, system)))
    begun = begin(state.q, state.v)
    jax.tree.map(np.testing.assert_array_equal, state.bodies, begun.bodies)
    np.testing.assert_array_equal(state.torso_xy, begun.torso_xy)
    for name in ("feet_contact", "smooth_feet_contact"):
        found, expected = getattr(state, name), getattr(begun, name)
        np.testing.assert_allclose(found[:2], expected[:2], rtol=1e-14)


@pytest.mark.parametrize(
    "robot",
    [ANT, pytest.param(HALFCHEETAH, marks=pytest.mark.slow), HUMANOID],
    ids=lambda r: r.name,
)
def test_gradients_of_readings(x64: None, robot: RobotSpec) -> None:
    system = system_of(robot)
    inputs = random_states(system, np.random.default_rng(3), 20)
    rng = np.random.default_rng(4)

    def readings(q: jax.Array, v: jax.Array, control: jax.Array) -> Any:
        start = physics.initial_state(system, q, v)
        after = physics.step(system, start, control)[0]
        return after.bodies, after.torso_xy, after.smooth_feet_contact

    shapes = jax.eval_shape(readings, *(x[0] for x in inputs))
    weights = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape), shapes)

    def value(*inputs: jax.Array) -> jax.Array:
        terms = jax.tree.map(lambda w, x: (w * x).sum(), weights, readings(*inputs))
        return sum(jax.tree.leaves(terms), jnp.zeros(()))

    errors = directional_errors(value, inputs)
    report("largest error for q, v, control", errors.max(axis=1))
    assert errors.max() < 1e-6


def test_feet_touch_above_one_percent_of_the_weight(x64: None) -> None:
    system = system_of(ANT)
    q, v, control = random_states(system, np.random.default_rng(5), 400)
    q[:, 2] += np.linspace(0.0, 0.03, 400)
    state, _ = step_of(system)(q, v, control)
    weight = system.total_mass * ANT.gravity * ANT.dt
    share = np.asarray(state.normal_impulse)[:, system.feet] / weight
    assert 0.1 < (share > 0.01).mean() < 0.9
    np.testing.assert_array_equal(state.feet_contact, share > 0.01)
    smooth = 1 / (1 + np.exp(-(share - 0.01) / WIDTH))
    np.testing.assert_allclose(state.smooth_feet_contact, smooth, rtol=1e-12)


@functools.cache
def algebraic(robot: RobotSpec, dtype: str = "float64") -> System:
    return physics.load_system(robot, dtype, feet_width=WIDTH, feet_tail="algebraic")


def test_algebraic_tail(x64: None) -> None:
    """The reading of the smooth step, its start without load, and its gradient."""
    system = algebraic(ANT)
    q, v, control = random_states(system, np.random.default_rng(5), 100)
    state, _ = step_of(system)(q, v, control)
    weight = system.total_mass * ANT.gravity * ANT.dt
    excess = np.asarray(state.normal_impulse)[:, system.feet] / weight - 0.01
    excess /= WIDTH
    expected = 0.5 + 0.5 * excess / (1 + np.sqrt(1 + excess**2))
    np.testing.assert_allclose(state.smooth_feet_contact, expected, rtol=1e-12)
    unloaded = expected[excess == excess.min()][0]
    assert excess.min() == pytest.approx(-0.01 / WIDTH)
    begun = physics.initial_state(system, q[0], v[0])
    np.testing.assert_allclose(begun.smooth_feet_contact, unloaded, rtol=1e-12)

    def value(q: jax.Array, v: jax.Array, control: jax.Array) -> jax.Array:
        start = physics.initial_state(system, q, v)
        return physics.step(system, start, control)[0].smooth_feet_contact.sum()

    some = tuple(x[:20] for x in (q, v, control))
    errors = directional_errors(value, some)
    report("largest error for q, v, control", errors.max(axis=1))
    assert errors.max() < 1e-6


@pytest.mark.parametrize("tail", ["exponential", "algebraic"])
def test_gradient_of_a_foot_that_stands(x64: None, tail: str) -> None:
    """In single precision it has the direction of double precision at every load.

    The exponential step ends at 1 - 1e-11 where feet carry half of the weight, and
    single precision rounds this to 1. The slope of the algebraic step is 1e8 times as
    large there.
    """
    gradients = []
    for dtype in ("float32", "float64"):
        system = physics.load_system(ANT, dtype, feet_width=0.02, feet_tail=tail)
        # all four feet are pressed in, until each carries half of the weight
        depths = np.linspace(0.002, 0.02, 8)
        q = np.tile(system.rest_q, (8, 1))
        q[:, 2] -= depths
        v = np.zeros((8, system.nv))

        def value(v: jax.Array, q: jax.Array, system: System = system) -> jax.Array:
            start = physics.initial_state(system, q, v)
            control = jnp.zeros(system.nu, system.dtype)
            return physics.step(system, start, control)[0].smooth_feet_contact.sum()

        slope = jax.jit(jax.vmap(jax.grad(value)))
        found = slope(v.astype(dtype), q.astype(np.float32).astype(dtype))
        gradients.append(np.asarray(found, np.float64))
    single, double = gradients
    norms = np.linalg.norm(single, axis=1), np.linalg.norm(double, axis=1)
    cosines = (single * double).sum(axis=1) / (norms[0] * norms[1])
    report("norm and cosine by depth", (norms[1], 1 - cosines))
    assert cosines.min() > 0.99999
    np.testing.assert_allclose(norms[0], norms[1], rtol=1e-3)
    if tail == "algebraic":
        assert norms[1].min() > 1e-3


def test_contact_that_is_not_smooth_has_no_gradient(x64: None) -> None:
    system = system_of(ANT)
    inputs = random_states(system, np.random.default_rng(3), 20)

    def touching(*inputs: jax.Array) -> jax.Array:
        return step_of(system)(*inputs)[0].feet_contact.sum()

    for gradient in jax.grad(touching, argnums=(0, 1, 2))(*map(jnp.asarray, inputs)):
        assert not np.asarray(gradient).any()


def test_fault_has_no_gradient(x64: None) -> None:
    system = system_of(HUMANOID)
    inputs = random_states(system, np.random.default_rng(6), 3)
    inputs[2][1] = np.nan

    def total(*inputs: jax.Array) -> jax.Array:
        leaves = jax.tree.leaves(step_of(system)(*inputs)[0])
        return sum((jnp.sin(leaf).sum() for leaf in leaves), jnp.zeros(()))

    gradients = jax.jit(jax.grad(total, argnums=(0, 1, 2)))(*inputs)
    for gradient in gradients:
        found = np.asarray(gradient)
        assert np.isfinite(found).all()
        assert not found[1].any() and found[0].any() and found[2].any()


def test_variants_are_made_once() -> None:
    plain = physics.load_system(ANT)
    assert physics.load_system(ANT, feet_width=plain.feet_width) is plain
    smooth = physics.load_system(ANT, feet_width=0.1)
    assert smooth is physics.load_system(ANT, feet_width=0.1)
    assert smooth is not plain and smooth.feet_width == 0.1
    assert dataclasses.replace(smooth).mass is plain.mass
    with pytest.raises(ValueError, match=r"feet_width: got 0.0.*above 0"):
        physics.load_system(ANT, feet_width=0.0)
    slow = physics.load_system(ANT, feet_tail="algebraic")
    assert slow is physics.load_system(ANT, feet_tail="algebraic") is not plain
    with pytest.raises(
        ValueError, match=r"feet_tail: got 'x'; allowed: exponential, a"
    ):
        physics.load_system(ANT, feet_tail="x")
