"""Finds which contacts and joint limits begin or end between two rollouts, and when."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from adjoint_helpers import Inputs

from newton_qd import physics
from newton_qd.physics.parameters import FIELDS
from newton_qd.physics.system import PhysicsState, System


def one_substep(system: System) -> System:
    """The same robot, whose control step is what was a substep."""
    robot = dataclasses.replace(system.robot, dt=system.h, substeps=1)
    return dataclasses.replace(system, robot=robot)


def limited_joints(system: System) -> tuple[np.ndarray, np.ndarray]:
    """Degrees of freedom (n,) that have limits, and the bodies (n,) of their joints."""
    dofs = np.flatnonzero(np.isfinite(system.limit_lower))
    return dofs, np.searchsorted(system.v_start, dofs, side="right") - 1


def gap_names(system: System) -> list[str]:
    """Bodies and joints (n,) whose gaps :func:`all_gaps` returns."""
    limits = [f"{system.joint_names[b]} (limit)" for b in limited_joints(system)[1]]
    return [*(system.body_names[b] for b in system.contact_body), *limits, *limits]


def all_gaps(system: System, q: jax.Array) -> jax.Array:
    """Gaps (n,) of contacts [m], then to the lower and upper limits [rad or m]."""
    dofs, bodies = limited_joints(system)
    at = q[system.q_start[bodies]]
    lower, upper = at - system.limit_lower[dofs], system.limit_upper[dofs] - at
    return jnp.concatenate([physics.contact_gaps(system, q), lower, upper])


@functools.cache
def gaps_of(env: Any) -> Callable[[Inputs], tuple[jax.Array, jax.Array]]:
    """Gaps (steps, substeps, n) in a rollout whose inputs have a plan, and its end."""
    base = env.unwrapped
    system, substeps = one_substep(base.system), base.system.substeps

    def run(inputs: Inputs) -> tuple[jax.Array, jax.Array]:
        params = physics.PhysicsParams(**{name: inputs[name] for name in FIELDS})

        def advance(state: PhysicsState, action: jax.Array) -> Any:
            control = base.control(state, action)

            def substep(state: PhysicsState, _: None) -> Any:
                after, _fault = physics.step(system, state, control, params)
                return after, all_gaps(system, state.q)

            return jax.lax.scan(substep, state, length=substeps)

        start = physics.initial_state(system, inputs["q"], inputs["v"])
        last, gaps = jax.lax.scan(advance, start, inputs["action"])
        return gaps, last.q

    return run


def changes(env: Any, one: Inputs, other: Inputs) -> jax.Array:
    """Control step (n,) in which a gap first has two signs; -1 where it has one."""
    run = gaps_of(env)
    differ = ((run(one)[0] > 0) != (run(other)[0] > 0)).any(axis=1)
    return jnp.where(differ.any(axis=0), jnp.argmax(differ, axis=0), -1)
