"""What contact must hold beside energy: convergence, friction, faults, gradients."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from energy_helpers import energy
from subjects import ACTIONS, Subject, finer, motion

import newton_qd
from newton_qd import physics
from newton_qd.physics.system import System
from newton_qd.robots import ACROBOT, Contact

FACTORS = (1, 2, 4)  # of the substeps, for the order in h
REFERENCE = 64  # times the substeps are taken for exact
SECONDS = 0.15  # that the order is measured over [s]
# Loads that count for friction: shares of what the weight is in a substep.
LEAST_LOAD = 1e-6


def advance(
    one: Subject, system: System, state: physics.PhysicsState, action: jax.Array
) -> tuple[physics.PhysicsState, jax.Array]:
    """A control step of one world, and its fault."""
    return physics.step(system, state, one.control(state, action))


@functools.cache
def ending(one: Subject, factor: int) -> Callable[..., tuple[jax.Array, jax.Array]]:
    """The last state of a batch as a function of q, v and actions (steps, worlds, na).

    Args:
        one: The robot.
        factor: How many times its substeps are taken.
    """
    system = one.system if factor == 1 else finer(one.system, factor)

    def run(
        q: jax.Array, v: jax.Array, actions: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        def step(state: Any, action: jax.Array) -> Any:
            after, _ = advance(one, system, state, action)
            return after, None

        first = physics.initial_state(system, q, v)
        last, _ = jax.lax.scan(step, first, actions)
        return last.q, last.v

    return jax.jit(jax.vmap(run, (0, 0, 1)))


def busy(one: Subject, worlds: int) -> tuple[np.ndarray, np.ndarray]:
    """States of robots on the ground: after 1 s of noise of half amplitude."""
    dt = one.system.robot.dt
    rng = np.random.default_rng(2)
    actions = 0.5 * motion("noise", rng, round(1.0 / dt), worlds, one.actions, dt)
    q, v = ending(one, 1)(*one.reset(worlds), actions)
    return np.asarray(q), np.asarray(v)


def errors(one: Subject, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Largest coordinate errors (factors, worlds) after 0.15 s [m or rad].

    Actions are noise of half amplitude, held over a control step of whatever h.
    """
    dt = one.system.robot.dt
    rng = np.random.default_rng(3)
    steps = max(round(SECONDS / dt), 1)
    actions = 0.5 * motion("noise", rng, steps, len(q), one.actions, dt)
    exact = np.asarray(ending(one, REFERENCE)(q, v, actions)[0])
    ends = [np.asarray(ending(one, factor)(q, v, actions)[0]) for factor in FACTORS]
    return np.array([np.abs(end - exact).max(axis=1) for end in ends])


@functools.cache
def cone(one: Subject) -> Callable[..., jax.Array]:
    """|J_t| / (mu J_n) of all contacts along a motion; NaN where little is carried.

    Returns:
        A function of q, v and actions (steps, worlds, na), to ratios of the shape
        (worlds, steps, substeps, contacts).
    """
    system = one.system
    robot = system.robot
    weight = system.total_mass * (robot.gravity or 9.81) * system.h

    def run(q: jax.Array, v: jax.Array, actions: jax.Array) -> jax.Array:
        def step(state: Any, action: jax.Array) -> Any:
            u = one.control(state, action)
            impulse, normal = physics.contact_impulses(system, state, u)
            sheared = jnp.sqrt(jnp.maximum((impulse**2).sum(axis=-1) - normal**2, 0))
            counts = normal > LEAST_LOAD * weight
            ratio = sheared / (robot.material.friction * jnp.where(counts, normal, 1))
            return physics.step(system, state, u)[0], jnp.where(counts, ratio, jnp.nan)

        return jax.lax.scan(step, physics.initial_state(system, q, v), actions)[1]

    return jax.jit(jax.vmap(run, (0, 0, 1)))


def friction_ratios(one: Subject, worlds: int, steps: int) -> np.ndarray:
    """|J_t| / (mu J_n) (n,) of all loaded contacts under all kinds of actions."""
    found = []
    for kind in ACTIONS:
        dt = one.system.robot.dt
        rng = np.random.default_rng(0)
        actions = motion(kind, rng, steps, worlds, one.actions, dt)
        ratios = np.asarray(cone(one)(*one.reset(worlds), actions))
        found.append(ratios[np.isfinite(ratios)])
    return np.concatenate(found)


@functools.cache
def _faults(one: Subject, steps: int) -> Callable[..., jax.Array]:
    def run(q: jax.Array, v: jax.Array, key: jax.Array) -> jax.Array:
        def step(carry: Any, key: jax.Array) -> Any:
            state, faults = carry
            action = jax.random.uniform(key, (one.actions,), q.dtype, -1, 1)
            state, fault = advance(one, one.system, state, action)
            return (state, faults + fault), None

        first = physics.initial_state(one.system, q, v), jnp.zeros((), jnp.int32)
        (_, faults), _ = jax.lax.scan(step, first, jax.random.split(key, steps))
        return faults

    return jax.jit(jax.vmap(run))


def faults(one: Subject, worlds: int, steps: int) -> np.ndarray:
    """Faulty control steps (worlds,) under noise."""
    keys = jax.random.split(jax.random.key(0), worlds)
    return np.asarray(_faults(one, steps)(*one.reset(worlds), keys))


def touching_acrobot() -> System:
    """An acrobot that could touch the ground, with an end that stays 0.9 m above it."""
    row = dataclasses.replace(ACROBOT, contacts=(Contact("pole", 1),))
    return physics.load_system(row, "float64")


@functools.cache
def _swing(system: System, steps: int) -> Callable[..., tuple[jax.Array, jax.Array]]:
    def run(q: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
        def step(state: Any, _: None) -> Any:
            after, fault = physics.step(system, state, jnp.zeros(system.nu))
            return after, (energy(system, after.q, after.v).total, fault)

        first = physics.initial_state(system, q, v)
        _, (held, fault) = jax.lax.scan(step, first, None, length=steps)
        start = energy(system, q, v)
        return (held - start.total) / start.kinetic, fault.sum()

    return jax.jit(jax.vmap(run))


def drift(system: System, speed: float, worlds: int, seconds: float) -> Any:
    """Change of energy (worlds, steps) as a share of the first kinetic one, and faults.

    The poles of an acrobot turn against each other at ``speed`` [rad/s] at first.
    """
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (worlds, 2))
    v = np.tile([speed, -speed], (worlds, 1))
    found = _swing(system, round(seconds / system.robot.dt))(q, v)
    return tuple(np.asarray(x) for x in found)


def gradient_norms(name: str, worlds: int, steps: int) -> np.ndarray:
    """Norms (worlds,) of the gradient of the return with respect to all actions.

    From ``worlds`` resets, at actions of noise.
    """
    env = newton_qd.create(name, episode_length=None, auto_reset=False, dtype="float64")

    def total(actions: jax.Array, key: jax.Array) -> jax.Array:
        def step(state: Any, action: jax.Array) -> Any:
            after = env.step(state, action)
            return after, after.reward

        return jax.lax.scan(step, env.reset(key), actions)[1].sum()

    keys = jax.random.split(jax.random.key(0), worlds)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.0, 1.0, (worlds, steps, env.action_size))
    gradients = jax.jit(jax.vmap(jax.grad(total)))(actions, keys)
    return np.linalg.norm(np.asarray(gradients).reshape(worlds, -1), axis=1)
