"""What the tests of the adjoints share: environments, their inputs and readings."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from contract import BOXES
from physics_helpers import beside_a_wall, random_states

import newton_qd
from newton_qd import physics, tasks
from newton_qd.envs.base import PhysicsEnv
from newton_qd.envs.state import State
from newton_qd.gradients import with_smooth_descriptor
from newton_qd.physics.model.rest import raising_coordinate
from newton_qd.physics.parameters import FIELDS
from newton_qd.robots import ROBOTS

WORLDS = 8
INPUTS = ("q", "v", "action", *FIELDS)
Inputs = dict[str, Any]


@functools.cache
def simulated() -> dict[str, str]:
    """Names of the simulated environments, and the URDF files of their robots.

    They are read from the specs, because every process that collects tests asks;
    :func:`make` compares. Those with boxes need kernels of their own, so tests of tasks
    and of boxes have their gradients.
    """
    found = {}
    for name, spec in tasks.ENVIRONMENTS.items():
        if name in BOXES:
            continue
        base: Any = spec.base
        while isinstance(base, functools.partial):
            base = base.func
        if not isinstance(base, type) or issubclass(base, PhysicsEnv):
            found[name] = (spec.robot or ROBOTS[spec.base_name]).urdf
    return found


@functools.cache
def make(name: str) -> Any:
    """The environment in double precision, its feet read smoothly."""
    env = newton_qd.create(name, episode_length=None, auto_reset=False, dtype="float64")
    base = env.unwrapped
    assert isinstance(base, PhysicsEnv) and base.robot.urdf == simulated()[name]
    return with_smooth_descriptor(env, 0.05)


def inputs_of(env: Any, worlds: int = WORLDS) -> Inputs:
    """What a step depends on, in several worlds that all differ.

    Of those of a legged robot half are pressed into the ground, and half are beside a
    wall where there are walls.
    """
    system, rng = env.unwrapped.system, np.random.default_rng(0)
    if raising_coordinate(system) is not None:
        q, v, action = random_states(system, rng, worlds)
        if system.scene is not None:
            q = beside_a_wall(system, q, rng)
    else:
        q = system.rest_q + 0.3 * rng.normal(size=(worlds, system.nq))
        v = rng.normal(size=(worlds, system.nv))
        action = rng.uniform(-1.0, 1.0, (worlds, env.action_size))
    params = {name: np.asarray(getattr(env.default_params, name)) for name in FIELDS}
    scales = {
        name: x * rng.uniform(0.7, 1.3, (worlds, *x.shape))
        for name, x in params.items()
    }
    return {"q": q, "v": v, "action": action, **scales}


@functools.cache
def readings(env: Any) -> Callable[..., jax.Array]:
    """Reward, observation, descriptor and impulses (n,) summed over some steps.

    The action is one for all steps (nu,), or each has its own (steps, nu).
    """
    first = jax.jit(env.reset)(jax.random.key(0))

    # A scan's step is traced to a program before JAX transforms it. So this is traced
    # once for all transformations, and what they see stays the same.
    @functools.partial(jax.jit, static_argnames=("steps", "unrolled"))
    def run(inputs: Inputs, steps: int = 1, unrolled: bool = False) -> jax.Array:
        params = physics.PhysicsParams(**{name: inputs[name] for name in FIELDS})
        start = physics.initial_state(env.unwrapped.system, inputs["q"], inputs["v"])

        actions = jnp.broadcast_to(inputs["action"], (steps, env.action_size))

        def advance(state: State, action: jax.Array) -> tuple[State, jax.Array]:
            state = env.step(state, action, params)
            seen = state.pipeline_state
            parts = [state.reward, state.obs, seen.impulse, seen.normal_impulse]
            parts.append(state.info.get("state_descriptor", jnp.zeros(0)))
            return state, jnp.concatenate([jnp.ravel(x) for x in parts])

        state = first.replace(pipeline_state=start)
        rows = jax.lax.scan(advance, state, actions, unroll=steps if unrolled else 1)
        return rows[1].sum(axis=0)

    return run


@functools.cache
def weighted(env: Any) -> Callable[..., jax.Array]:
    """A random linear functional of the readings."""
    read = readings(env)  # here, because a trace of ``value`` must not reset

    def value(inputs: Inputs, *options: Any) -> jax.Array:
        seen = read(inputs, *options)
        return (weights_of(len(seen)) * seen).sum()

    return value


def weights_of(count: int) -> np.ndarray:
    """Weights (count,) of the readings in the functional."""
    return np.random.default_rng(1).normal(size=count)


def norms(x: Any) -> np.ndarray:
    """Norm of each world's part (n,)."""
    return np.linalg.norm(np.asarray(x).reshape(len(x), -1), axis=1)


def along(a: Any, b: Any) -> np.ndarray:
    """Inner product of each world's parts (n,)."""
    return (np.asarray(a) * b).reshape(len(a), -1).sum(axis=1)
