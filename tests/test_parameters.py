"""Physical parameters of each world: what they do, their adjoints, what is refused."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contract import row, same
from physics_helpers import BOX_HEIGHT, box_system, functional, random_states, report

import newton_qd
from newton_qd import physics
from newton_qd.envs.base import Env
from newton_qd.envs.state import State
from newton_qd.physics.parameters import FIELDS, parameter_row, parameter_shapes
from newton_qd.physics.system import PhysicsState, System
from newton_qd.robots import ANT, HOPPER, ROBOTS, RobotSpec

WORLDS = 16
Params = physics.PhysicsParams


def draw(system: System, worlds: int, seed: int = 0) -> Params:
    """Parameters of worlds that all differ from the files in every entry."""
    rng = np.random.default_rng(seed)
    default = physics.default_params(system)
    return jax.tree.map(
        lambda x: jnp.asarray(x * rng.uniform(0.5, 1.5, (worlds, *x.shape)), x.dtype),
        default,
    )


def inputs(system: System, worlds: int = WORLDS) -> tuple[PhysicsState, jax.Array]:
    """States, half of them in contact, and actions."""
    states = random_states(system, np.random.default_rng(0), worlds)
    q, v, control = (jnp.asarray(x, system.dtype) for x in states)
    start = functools.partial(physics.initial_state, system)
    return jax.jit(jax.vmap(start))(q, v), control


def close(found: Any, expected: Any) -> bool:
    """Whether two pytrees are equal up to the order in which sums were taken."""
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
    return all(
        np.allclose(a, b, rtol=1e-10, atol=1e-12 * (1.0 + np.abs(b).max()))
        for a, b in pairs
    )


@functools.cache
def stepped(system: System) -> Callable[..., tuple[PhysicsState, jax.Array]]:
    """The jitted step of a batch of worlds with parameters of their own."""
    return jax.jit(jax.vmap(functools.partial(physics.step, system)))


def changed(system: System, params: Params) -> System:
    """The system whose files say what the parameters of one world say."""
    one = {name: np.asarray(getattr(params, name), np.float64) for name in FIELDS}
    material = dataclasses.replace(
        system.robot.material, friction=float(one["friction"])
    )
    scale = one["mass_scale"] * one["inertia_scale"]
    return dataclasses.replace(
        system,
        robot=dataclasses.replace(
            system.robot, gravity=float(one["gravity"]), material=material
        ),
        contact_stiffness=system.contact_stiffness
        * float(one["contact_stiffness_scale"]),
        mass=system.mass * one["mass_scale"],
        inertia=system.inertia * scale[:, None, None],
        damping=system.damping * one["damping_scale"],
        gear=system.gear * one["gear_scale"],
    )


@pytest.mark.slow
@pytest.mark.parametrize("robot", [ANT, HOPPER], ids=lambda robot: robot.name)
def test_parameters_are_as_if_in_the_files(x64: None, robot: RobotSpec) -> None:
    system = physics.load_system(robot, "float64")
    state, control = inputs(system)
    params = draw(system, WORLDS)
    after, fault = stepped(system)(state, control, params)
    assert not fault.any()
    plain = stepped(system)(state, control)[0]
    # as NumPy's: JAX would compile every slice of it
    state, control, params, after, plain = jax.device_get(
        (state, control, params, after, plain)
    )
    for world in (0, WORLDS - 1):
        at = functools.partial(jax.tree.map, lambda x, world=world: x[world])
        twin = changed(system, at(params))
        expected = jax.jit(functools.partial(physics.step, twin))(
            at(state), at(control)
        )[0]
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11),
            at(after),
            expected,
        )
        assert np.abs(at(after).v - at(plain).v).max() > 1e-3


@pytest.mark.slow
def test_defaults_change_no_digit(x64: None, device: Any) -> None:
    """Neither of what a step returns nor of its gradients."""
    system = physics.load_system(ANT, "float64")
    state, control = inputs(system)
    params = physics.default_params(system)

    def step(q: jax.Array, v: jax.Array, control: jax.Array, *own: Params) -> Any:
        state = physics.initial_state(system, q, v)
        return jax.tree.leaves(physics.step(system, state, control, *own)[0])

    def run(*own: Params) -> Any:
        def several(q: jax.Array, v: jax.Array, control: jax.Array) -> Any:
            return jax.vmap(lambda *x: step(*x, *own))(q, v, control)

        values, back = jax.vjp(several, state.q, state.v, control)
        return values, back(jax.tree.map(jnp.cos, values))

    agree = same if device.platform == "cpu" else close  # lanes add in any order
    (values, gradients), (own_values, own) = jax.jit(run)(), jax.jit(run)(params)
    assert same(values, own_values)
    assert agree(gradients, own)


def rows(params: Params) -> jax.Array:
    """Parameters of several worlds as rows (n, numbers)."""
    leaves = [jnp.asarray(getattr(params, name)) for name in FIELDS]
    return jnp.concatenate([x.reshape(len(x), -1) for x in leaves], axis=1)


def ends(system: System) -> np.ndarray:
    """Where the fields of a row end."""
    return np.cumsum([math.prod(shape) for shape in parameter_shapes(system).values()])


def from_row(system: System, numbers: jax.Array) -> Params:
    """Parameters of one world from a row (numbers,)."""
    parts = jnp.split(numbers, ends(system)[:-1])
    shapes = parameter_shapes(system).items()
    pairs = zip(shapes, parts, strict=True)
    return Params(**{name: part.reshape(shape) for (name, shape), part in pairs})


def derivatives(
    system: System, steps: int, worlds: int, distance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Gradients (n, numbers) of a random functional to each world's parameters.

    The functional takes everything that the control steps return: state, impulses.

    Returns:
        By the adjoint, and by central differences of every number alone.
    """
    weigh = functional(system, steps)
    state, control = inputs(system, worlds)
    start = rows(draw(system, worlds))

    def value(own: jax.Array, q: jax.Array, v: jax.Array, u: jax.Array) -> jax.Array:
        return weigh(q, v, u, from_row(system, own))

    arguments = (state.q, state.v, control)
    gradient = jax.jit(jax.vmap(jax.grad(value)))(start, *arguments)
    each = jax.vmap(value, (0, None, None, None))
    several = jax.jit(jax.vmap(each))
    moves = distance * jnp.eye(start.shape[1], dtype=start.dtype)
    ahead = several(start[:, None] + moves, *arguments)
    behind = several(start[:, None] - moves, *arguments)
    return np.asarray(gradient), np.asarray(ahead - behind) / (2 * distance)


@pytest.mark.slow
@pytest.mark.parametrize("robot", [ANT, HOPPER], ids=lambda robot: robot.name)
def test_gradient_of_a_step(x64: None, robot: RobotSpec) -> None:
    """Every number of every parameter against differences, in and out of contact."""
    system = physics.load_system(robot, "float64")
    gradient, difference = derivatives(system, 1, WORLDS, 1e-5)
    fields = zip(
        FIELDS,
        np.split(gradient, ends(system), axis=1),
        np.split(difference, ends(system), axis=1),
        strict=False,
    )
    for name, exact, found in fields:
        size = np.linalg.norm(exact, axis=1)
        error = np.linalg.norm(exact - found, axis=1)
        felt = size > 0
        report(f"largest relative error, {name}", (error[felt] / size[felt]).max())
        assert (error <= 1e-6 * size).all(), name
        # in the air contacts have no effect; on the ground everything has
        assert felt[: WORLDS // 2].all(), name


@pytest.mark.slow
@pytest.mark.parametrize("robot", [ANT, HOPPER], ids=lambda robot: robot.name)
def test_gradient_of_many_steps(x64: None, robot: RobotSpec) -> None:
    system = physics.load_system(robot, "float64")
    gradient, difference = derivatives(system, 32, 8, 1e-6)
    sizes = np.linalg.norm(gradient, axis=1) * np.linalg.norm(difference, axis=1)
    cosine = (gradient * difference).sum(axis=1) / sizes
    report("largest 1 - cosine", 1.0 - cosine.min())
    assert np.isfinite(gradient).all()
    assert (cosine > 0.999999).all()


@functools.cache
def task(**options: Any) -> Env:
    """An ant that runs; its descriptor has a gradient."""
    smooth = [{"smooth_width": 0.05}]
    return newton_qd.create("ant_uni", qdax_wrappers_kwargs=smooth, **options)


def readings(state: State) -> jax.Array:
    """Reward, observation, state descriptor and contact impulses of one world."""
    parts = (state.reward, state.obs, state.info["state_descriptor"])
    parts = (*parts, state.pipeline_state.impulse, state.pipeline_state.normal_impulse)
    return jnp.concatenate([jnp.ravel(part) for part in parts])


@pytest.mark.slow
def test_jacobian_of_an_episode(x64: None) -> None:
    """All that a step of an environment returns, under every transformation."""
    env = task(auto_reset=False, dtype="float64")
    system = env.unwrapped.system  # pyright: ignore[reportAttributeAccessIssue]
    start = env.unwrapped.default_params
    actions = jax.random.uniform(jax.random.key(1), (8, 8), np.float64, -1.0, 1.0)
    first = jax.jit(env.reset)(jax.random.key(0))

    def episode(numbers: jax.Array) -> jax.Array:
        params = from_row(system, numbers)

        def advance(state: State, action: jax.Array) -> tuple[State, jax.Array]:
            state = env.step(state, action, params)
            return state, readings(state)

        return jax.lax.scan(advance, first, actions)[1].sum(axis=0)

    here = rows(jax.tree.map(lambda x: x[None], start))[0]
    jacobian = np.asarray(jax.jit(jax.jacrev(episode))(here))
    moves = 1e-6 * jnp.eye(len(here), dtype=here.dtype)
    several = jax.jit(jax.vmap(episode))
    difference = np.asarray(several(here + moves) - several(here - moves)).T / 2e-6
    report("largest error", np.abs(jacobian - difference).max())
    largest = np.abs(jacobian).max()
    np.testing.assert_allclose(jacobian, difference, rtol=1e-5, atol=1e-6 * largest)
    descriptor = slice(1 + env.observation_size, 1 + env.observation_size + 4)
    assert (np.abs(jacobian[descriptor]).max(axis=1) > 0).all()
    gradient = jax.jit(jax.grad(lambda x: episode(x)[0]))(here)
    np.testing.assert_allclose(gradient, jacobian[0], rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_worlds_are_independent(x64: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other parameters of one world, and numbers that are none, leave the rest alone.

    Bitwise, values and gradients; where a world is at fault its gradient is zero.
    """
    monkeypatch.setenv("NEWTON_QD_LANES", "1")  # the deterministic mode of a GPU
    system = physics.load_system(ANT, "float64")
    state, control = inputs(system)
    params = draw(system, WORLDS)

    @jax.jit
    def values_and_gradients(params: Params) -> Any:
        def several(params: Params, control: jax.Array) -> Any:
            after, fault = jax.vmap(functools.partial(physics.step, system))(
                state, control, params
            )
            return jax.tree.leaves(after), fault

        values, back, fault = jax.vjp(several, params, control, has_aux=True)
        return values, back(jax.tree.map(jnp.cos, values)), fault

    before = values_and_gradients(params)
    others = np.arange(WORLDS) != 3
    for name in FIELDS:
        for number in (1.25, np.nan):
            field = getattr(params, name)
            spoilt = params.replace(**{name: field.at[3].multiply(number)})
            after = values_and_gradients(spoilt)
            assert same(row(after, others), row(before, others)), (name, number)
            assert not same(row(after, 3), row(before, 3)), (name, number)
            broken = np.isnan(number)
            assert after[2][3] == broken
            assert all(np.isfinite(x).all() for x in jax.tree.leaves(after))
            if broken:
                assert not any(x[3].any() for x in jax.tree.leaves(after[1]))
                assert same(after[0][0][3], state.q[3])


@pytest.mark.slow
def test_value_with_gradient_is_the_value_without(x64: None) -> None:
    system = physics.load_system(ANT, "float64")
    state, control = inputs(system)
    params = draw(system, WORLDS)

    def several(params: Params) -> Any:
        return jax.vmap(functools.partial(physics.step, system))(state, control, params)

    plain = jax.jit(several)(params)
    recorded = jax.jit(lambda p: jax.vjp(lambda x: several(x)[0], p)[0])(params)
    assert same(plain[0], recorded)


@pytest.mark.slow
def test_transformations_agree(x64: None) -> None:
    """Gradients of batches, of nested batches, of shared parameters, of a remat."""
    system = physics.load_system(ANT, "float64")
    state, control = inputs(system, 4)
    params = draw(system, 4)
    weigh = functional(system, 2)

    def value(params: Params, q: jax.Array, v: jax.Array, u: jax.Array) -> jax.Array:
        return weigh(q, v, u, params)

    # as NumPy's: JAX would compile every slice of it
    arguments = jax.device_get((params, state.q, state.v, control))
    inner = jax.jit(jax.vmap(jax.grad(value)))(*arguments)
    outer = jax.jit(jax.grad(lambda *x: jax.vmap(value)(*x).sum()))(*arguments)
    pairs = jax.tree.map(lambda x: x.reshape(2, 2, *x.shape[1:]), arguments)
    nested = jax.device_get(jax.jit(jax.vmap(jax.vmap(jax.grad(value))))(*pairs))
    again = jax.jit(jax.vmap(jax.grad(jax.checkpoint(value))))(*arguments)
    flat = jax.tree.map(lambda x: x.reshape(4, *x.shape[2:]), nested)
    for found in (outer, flat, again):
        assert close(found, inner)
    # one set of parameters for all worlds: its gradient is the sum
    one = jax.tree.map(lambda x: x[0], params)
    all_worlds = jax.vmap(value, (None, 0, 0, 0))
    shared = jax.jit(jax.grad(lambda *x: all_worlds(*x).sum()))(one, *arguments[1:])
    each = jax.jit(jax.vmap(jax.grad(value), (None, 0, 0, 0)))(one, *arguments[1:])
    total = jax.tree.map(lambda x: x.sum(axis=0), jax.device_get(each))
    assert close(shared, total)


def in_the_air() -> tuple[System, PhysicsState, jax.Array]:
    """An ant at rest, high above the ground, and actions that do nothing."""
    system = physics.load_system(ANT, "float64")
    q = system.rest_q.copy()
    q[2] = 3.0
    begin = jax.jit(lambda q, v: physics.initial_state(system, q, v))
    return system, begin(q, np.zeros(system.nv)), jnp.zeros(system.nu)


def test_gravity_in_free_flight(x64: None) -> None:
    """Closed form: a robot at rest in the air falls as gravity says, whatever it is."""
    system, state, still = in_the_air()
    default = physics.default_params(system)
    for gravity in (0.0, 9.8, 19.6):
        params = default.replace(gravity=gravity)
        after, _ = physics.step(system, state, still, params)
        fall = np.zeros(system.nv)
        fall[2] = -gravity * system.robot.dt
        np.testing.assert_allclose(after.v, fall, atol=1e-12)


@pytest.mark.slow
def test_a_fall_has_the_gradient_of_gravity(x64: None) -> None:
    """Closed form: the velocity after a step is -g dt."""
    system, state, still = in_the_air()
    default = physics.default_params(system)

    def velocity(gravity: jax.Array) -> jax.Array:
        params = default.replace(gravity=gravity)
        return physics.step(system, state, still, params)[0].v[2]

    found = jax.grad(velocity)(jnp.asarray(9.8))
    assert found == pytest.approx(-system.robot.dt, rel=1e-12)


def test_friction_holds_a_box(x64: None, tmp_path: Path) -> None:
    """Without it a box slides down as fast as a point; with it, it stays."""
    angle, steps = 0.2, 100
    system = box_system(tmp_path, angle)
    default = physics.default_params(system)

    @jax.jit
    def slide(friction: float) -> jax.Array:
        def advance(state: PhysicsState, _: None) -> tuple[PhysicsState, None]:
            params = default.replace(friction=friction)
            return physics.step(system, state, jnp.zeros(0), params)[0], None

        tilt = jnp.array([0.0, np.sin(angle / 2), 0.0, np.cos(angle / 2)])
        normal = jnp.array([np.sin(angle), 0.0, np.cos(angle)])
        q = jnp.concatenate([BOX_HEIGHT * normal, tilt])
        start = physics.initial_state(system, q, jnp.zeros(6))
        return jax.lax.scan(advance, start, None, length=steps)[0].v

    along = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    free = system.robot.gravity * np.sin(angle) * steps * system.robot.dt
    assert slide(0.0)[:3] @ along == pytest.approx(free, rel=1e-3)
    assert abs(slide(1.0)[:3] @ along) < 0.05 * free


def test_default_parameters_are_those_of_the_robot() -> None:
    for name in ("halfcheetah", "fetch"):
        found = physics.default_params(physics.load_system(ROBOTS[name]))
        assert found.friction == np.float32(ROBOTS[name].material.friction) != 1
        assert found.gravity == np.float32(ROBOTS[name].gravity)


@pytest.mark.parametrize("field", ["mass_scale", "inertia_scale"])
def test_a_body_has_mass_and_inertia(field: str) -> None:
    system = physics.load_system(ROBOTS["hopper"])
    params = physics.default_params(system)
    zero = {field: 0 * getattr(params, field)}
    with pytest.raises(ValueError, match=f"params.{field}: got 0.0; allowed: finite"):
        parameter_row(system, params.replace(**zero))
