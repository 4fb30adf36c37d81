"""The energy of a world, and what a substep gains beyond the work of the motors.

The energy of a state is kinetic, of gravity, of joint springs, and elastic: what limits
and contacts store. Their force is a stiffness times the smooth penetration x(gap), so
they store that stiffness times the integral of x. Forces that depend on velocity
(damping, dissipation, friction) have no energy: they may only take some away.

The work of a motor in a substep is its torque, gear times control, times the way that
its joint has gone. The torque is constant over the substep, so this is exact for every
scheme. A servo is a spring to angle 0 and a motor with the torque of its target.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from subjects import Control, Subject, motion, one_substep, poses, undriven

from newton_qd import physics
from newton_qd.physics.system import JointKind, System

FLOOR = 2.0  # gain of a substep that counts for nothing [J]
SHARE = 0.01  # of the world's largest kinetic energy, which counts for nothing
# Halfcheetah with fast and light feet, from issue 17: kinetic energy 87 J.
FAST_FEET = (
    np.array([0.0, 0.405, -0.718, -0.617, -0.876, 0.883, 0.253, 0.146, 0.536]),
    np.array([-0.03, 0.7, 0.16, 4.36, -9.42, 14.57, 2.66, 40.53, -6.87]),
)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Energy:
    """Parts of the mechanical energy of a world [J], each of shape ().

    Attributes:
        kinetic: Of all bodies and rotors.
        gravity: Of all weights, zero at height 0.
        springs: Of joint springs, those of servos too.
        limits: Stored in joint limits.
        contacts: Stored in contacts, each pair once.
    """

    kinetic: Any
    gravity: Any
    springs: Any
    limits: Any
    contacts: Any

    @property
    def rigid(self) -> Any:
        """Energy without what limits and contacts store."""
        return self.kinetic + self.gravity + self.springs

    @property
    def elastic(self) -> Any:
        """What limits and contacts store."""
        return self.limits + self.contacts

    @property
    def potential(self) -> Any:
        """Everything but the kinetic energy."""
        return self.gravity + self.springs + self.elastic

    @property
    def total(self) -> Any:
        """All of it."""
        return self.rigid + self.elastic


def compressed(gap: Any, width: float) -> Any:
    """Integral of the smooth penetration from ``gap`` on, the energy of a unit spring.

    Inside the zone x = w u^3 (4 - u) / 16 with u = 1 - gap / w.
    """
    u = jnp.clip(1.0 - gap / width, 0.0, 2.0)
    inside = width**2 / 16 * (u**4 - u**5 / 5)
    deep = jnp.minimum(gap, -width)
    return inside + 0.5 * (deep**2 - width**2)


def energy(system: System, q: jax.Array, v: jax.Array) -> Energy:
    """The energy of one world in float64."""
    bodies = physics.forward_kinematics(system, q, v)
    x, y, z, w = (bodies.rotation[:, i] for i in range(4))
    axes = jnp.stack(
        [
            jnp.stack(
                [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
            ),
            jnp.stack(
                [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)]
            ),
            jnp.stack(
                [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
            ),
        ]
    )  # (axis of the body, component, body)
    spin = jnp.einsum("ajb,bj->ba", axes, bodies.angular_velocity)
    kinetic = 0.5 * (
        (system.mass * (bodies.linear_velocity**2).sum(axis=1)).sum()
        + jnp.einsum("bi,bij,bj->", spin, system.inertia, spin)
        + (system.armature * v**2).sum()
    )
    gravity = system.robot.gravity * (system.mass * bodies.com[:, 2]).sum()
    single = np.flatnonzero(system.joint_kind != JointKind.FREE)
    angle, dof = q[system.q_start[single]], system.v_start[single]
    stretched = angle - system.spring_rest[dof]
    springs = 0.5 * (system.stiffness[dof] * stretched**2).sum()
    material = system.robot.material
    width = material.limit_smoothing
    # the zone of a limit begins at the limit
    sides = (
        np.clip(system.limit_lower[dof], -1e9, None) - width,
        np.clip(system.limit_upper[dof], None, 1e9) + width,
    )
    bent = compressed(angle - sides[0], width) + compressed(sides[1] - angle, width)
    limits = (system.limit_stiffness[dof] * bent).sum()
    gaps = physics.contact_gaps(system, q)
    # both rows of a pair have its gap
    once = np.where(system.contact_obstacle < 0, 0.5, 1.0)
    pressed = (once * compressed(gaps, material.smoothing)).sum()
    contacts = system.contact_stiffness * pressed
    return Energy(kinetic, gravity, springs, limits, contacts)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Ledger:
    """Energies along a motion, for every world and substep.

    Attributes:
        energy: Parts (substeps + 1, worlds) [J]; the first row is the start.
        work: (substeps, worlds) work of the motors in each substep [J].
        fault: (substeps, worlds) 1 where a world had a fault.
        q: (nq,) coordinates at the end, for every world [m or rad].
        v: (nv,) velocities at the end, for every world [m/s or rad/s].
    """

    energy: Energy
    work: Any
    fault: Any
    q: Any
    v: Any

    def gains(self, elastic: bool = True) -> np.ndarray:
        """Energy (substeps, worlds) that each substep gains beyond motor work [J]."""
        held = np.asarray(self.energy.total if elastic else self.energy.rigid)
        return np.diff(held, axis=0) - np.asarray(self.work)

    @property
    def largest_kinetic(self) -> np.ndarray:
        """Largest kinetic energy (worlds,) of each world [J]."""
        return np.asarray(self.energy.kinetic).max(axis=0)


@functools.cache
def ledger(system: System, control: Control = undriven) -> Callable[..., Ledger]:
    """The jitted motion of a batch of worlds, substep by substep.

    Args:
        system: The system, with its own substeps.
        control: Maps a state and an action to what the actuators get.

    Returns:
        A function of q (worlds, nq), v (worlds, nv) and actions (steps, worlds, na).
    """
    short = one_substep(system)
    starts = {
        int(v): int(q) for v, q in zip(system.v_start, system.q_start, strict=True)
    }
    driven = np.array([starts[int(dof)] for dof in system.control_dof], np.int32)

    def state_of(q: jax.Array, v: jax.Array) -> physics.PhysicsState:
        return physics.initial_state(short, q, v)

    def substep(carry: Any, u: jax.Array) -> Any:
        q, v = carry
        after, fault = physics.step(short, state_of(q, v), u)
        work = (system.gear * u * (after.q[driven] - q[driven])).sum()
        return (after.q, after.v), (energy(short, after.q, after.v), work, fault)

    several = jax.vmap(substep)

    def run(q: jax.Array, v: jax.Array, actions: jax.Array) -> Ledger:
        first = jax.vmap(lambda q, v: energy(short, q, v))(q, v)

        def advance(carry: Any, action: jax.Array) -> Any:
            q, v = carry
            u = jax.vmap(lambda q, v, a: control(state_of(q, v), a))(q, v, action)
            return jax.lax.scan(
                lambda carry, _: several(carry, u), carry, length=system.substeps
            )

        (q, v), found = jax.lax.scan(advance, (q, v), actions)
        parts, work, fault = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), found)
        parts = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, parts)
        return Ledger(parts, work, fault, q, v)

    return jax.jit(run)


@dataclasses.dataclass(frozen=True)
class Gain:
    """What a motion gains beyond motor work, over all worlds and substeps.

    Attributes:
        largest: Largest gain of a substep [J].
        share: Largest gain of a substep, as a share of the largest kinetic energy of
            its world [-].
        worlds: Share of the worlds with a substep beyond the bar.
        substeps: Share of the substeps beyond the bar.
        faults: Share of the worlds that had a fault.
    """

    largest: float
    share: float
    worlds: float
    substeps: float
    faults: float


def judge(found: Ledger, elastic: bool = True) -> Gain:
    """Measures the gains: beyond the bar is more than 2 J and more than 1 %."""
    gains, kinetic = found.gains(elastic), found.largest_kinetic
    beyond = gains > np.maximum(FLOOR, SHARE * kinetic)
    return Gain(
        float(gains.max()),
        float((gains / kinetic).max()),
        float(beyond.any(axis=0).mean()),
        float(beyond.mean()),
        float(np.asarray(found.fault).any(axis=0).mean()),
    )


def driven(one: Subject, kind: str, worlds: int, steps: int) -> Ledger:
    """The motion of a robot from reset states under actions of one kind."""
    rng = np.random.default_rng(0)
    dt = one.system.robot.dt
    actions = motion(kind, rng, steps, worlds, one.actions, dt)
    return ledger(one.system, one.control)(*one.reset(worlds), actions)


def dropped(one: Subject, worlds: int, seconds: float) -> Ledger:
    """The motion from :func:`poses` at rest, with controls of zero."""
    system = one.system
    q = poses(system, worlds)
    steps = round(seconds / system.robot.dt)
    zero = np.zeros((steps, worlds, system.nu))
    return ledger(system)(q, np.zeros((worlds, system.nv)), zero)


def fast_feet(system: System, steps: int = 2) -> Ledger:
    """The motion of one halfcheetah from ``FAST_FEET``, without actions."""
    q, v = (x[None] for x in FAST_FEET)
    return ledger(system)(q, v, np.zeros((steps, 1, system.nu)))


def excess(found: Ledger) -> np.ndarray:
    """Largest rise (worlds,) over the first energy, of a drop.

    As a share of the energy that the drop can spend: the first energy above the lowest
    potential energy that the world reaches.
    """
    total = np.asarray(found.energy.total)
    lowest = np.asarray(found.energy.potential).min(axis=0)
    # a robot without weight and springs has nothing to spend, and may not move
    return (total - total[0]).max(axis=0) / np.maximum(total[0] - lowest, 1e-9)
