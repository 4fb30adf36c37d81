"""Physical parameters of each world: what they do, their adjoints, what is refused."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contract import same
from physics_helpers import functional, random_states, report

import newton_qd
from newton_qd import physics
from newton_qd.envs.base import Env
from newton_qd.envs.state import State
from newton_qd.physics.parameters import FIELDS, parameter_shapes
from newton_qd.physics.system import PhysicsState, System
from newton_qd.robots import ANT, HOPPER, Robot

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
    return jax.vmap(start)(q, v), control


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


@pytest.mark.parametrize("robot", [ANT, HOPPER], ids=lambda robot: robot.name)
def test_parameters_are_as_if_in_the_files(x64: None, robot: Robot) -> None:
    system = physics.load_system(robot, "float64")
    state, control = inputs(system)
    params = draw(system, WORLDS)
    after, fault = stepped(system)(state, control, params)
    assert not fault.any()
    plain = stepped(system)(state, control)[0]
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


def test_defaults_change_no_digit(x64: None) -> None:
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

    assert same(jax.jit(run)(), jax.jit(run)(params))


def rows(params: Params) -> jax.Array:
    """Parameters of several worlds as rows (n, numbers)."""
    leaves = [jnp.asarray(getattr(params, name)) for name in FIELDS]
    return jnp.concatenate([x.reshape(len(x), -1) for x in leaves], axis=1)


def ends(system: System) -> np.ndarray:
    """Where the fields of a row end."""
    return np.cumsum([math.prod(shape) for shape in parameter_shapes(system).values()])


def from_row(system: System, row: jax.Array) -> Params:
    """Parameters of one world from a row (numbers,)."""
    parts = jnp.split(row, ends(system)[:-1])
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

    def value(row: jax.Array, q: jax.Array, v: jax.Array, u: jax.Array) -> jax.Array:
        return weigh(q, v, u, from_row(system, row))

    arguments = (state.q, state.v, control)
    gradient = jax.jit(jax.vmap(jax.grad(value)))(start, *arguments)
    each = jax.vmap(value, (0, None, None, None))
    several = jax.jit(jax.vmap(each))
    moves = distance * jnp.eye(start.shape[1], dtype=start.dtype)
    ahead = several(start[:, None] + moves, *arguments)
    behind = several(start[:, None] - moves, *arguments)
    return np.asarray(gradient), np.asarray(ahead - behind) / (2 * distance)


@pytest.mark.parametrize("robot", [ANT, HOPPER], ids=lambda robot: robot.name)
def test_gradient_of_a_step(x64: None, robot: Robot) -> None:
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


@pytest.mark.parametrize("robot", [ANT, HOPPER], ids=lambda robot: robot.name)
def test_gradient_of_many_steps(x64: None, robot: Robot) -> None:
    system = physics.load_system(robot, "float64")
    gradient, difference = derivatives(system, 32, 8, 1e-6)
    sizes = np.linalg.norm(gradient, axis=1) * np.linalg.norm(difference, axis=1)
    cosine = (gradient * difference).sum(axis=1) / sizes
    report("cosines", cosine)
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


def test_jacobian_of_an_episode(x64: None) -> None:
    """All that a step of an environment returns, under every transformation."""
    env = task(auto_reset=False, dtype="float64")
    system = env.unwrapped.system  # pyright: ignore[reportAttributeAccessIssue]
    start = env.unwrapped.default_params
    actions = jax.random.uniform(jax.random.key(1), (8, 8), np.float64, -1.0, 1.0)
    first = jax.jit(env.reset)(jax.random.key(0))

    def episode(row: jax.Array) -> jax.Array:
        params = from_row(system, row)

        def advance(state: State, action: jax.Array) -> tuple[State, jax.Array]:
            state = env.step(state, action, params)
            return state, readings(state)

        return jax.lax.scan(advance, first, actions)[1].sum(axis=0)

    row = rows(jax.tree.map(lambda x: x[None], start))[0]
    jacobian = np.asarray(jax.jit(jax.jacrev(episode))(row))
    moves = 1e-6 * jnp.eye(len(row), dtype=row.dtype)
    several = jax.jit(jax.vmap(episode))
    difference = np.asarray(several(row + moves) - several(row - moves)).T / 2e-6
    report("largest error", np.abs(jacobian - difference).max())
    largest = np.abs(jacobian).max()
    np.testing.assert_allclose(jacobian, difference, rtol=1e-5, atol=1e-6 * largest)
    descriptor = slice(1 + env.observation_size, 1 + env.observation_size + 4)
    assert (np.abs(jacobian[descriptor]).max(axis=1) > 0).all()
    gradient = jax.jit(jax.grad(lambda x: episode(x)[0]))(row)
    np.testing.assert_allclose(gradient, jacobian[0], rtol=1e-9, atol=1e-12)
