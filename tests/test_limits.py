"""Joint limits of every robot: nothing is felt on them, and full gear is held."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import numpy as np
import pytest
from physics_helpers import DISTINCT, batched_step, report, rollout, variant

from newton_qd.physics import load_system
from newton_qd.physics.system import JointKind, PhysicsState, System
from newton_qd.robots import ROBOTS

SECONDS = 4.0  # after which a joint under full gear is still
# Robots with limits that a torque can push against; a servo pulls back from there.
LIMITED = [
    name
    for name in DISTINCT
    if np.any(load_system(ROBOTS[name]).limit_stiffness) and not ROBOTS[name].servos
]


def floating(name: str, **changes: object) -> System:
    """A robot without weight and ground, so that only its joints act."""
    row = ROBOTS[name]
    return variant(
        row, "float32", gravity=0.0, contacts=(), feet=(), rest_height=None, **changes
    )


def on_limits(system: System) -> np.ndarray:
    """Coordinates (2, nq) with every limited joint on its lower or upper limit."""
    q = np.tile(system.rest_q, (2, 1))
    for body in np.flatnonzero(system.joint_kind == JointKind.REVOLUTE):
        dof, at = system.v_start[body], system.q_start[body]
        for side, limit in enumerate(
            (system.limit_lower[dof], system.limit_upper[dof])
        ):
            q[side, at] = limit if np.isfinite(limit) else q[side, at]
    return q.astype(np.float32)


@pytest.mark.parametrize("name", LIMITED)
def test_a_pose_on_its_limits_feels_nothing(name: str) -> None:
    """Less than 2 % of what the gear of the joint does in the same time."""
    system = floating(name)
    q = on_limits(system)
    still = np.zeros((2, system.nv), np.float32)
    none = np.zeros((2, system.nu), np.float32)
    inward = np.array([[1.0], [-1.0]], np.float32) + none
    let_go = np.asarray(batched_step(system)(q, still, none)[1])
    driven = np.asarray(batched_step(system)(q, still, inward)[1])
    share = np.abs(let_go).max() / np.abs(driven).max(axis=1).min()
    report("share of the gear", share)
    assert share < 0.02


@functools.cache
def rollouts(system: System) -> Callable[..., PhysicsState]:
    """The jitted rollout of a batch of worlds."""
    return jax.jit(jax.vmap(rollout(system)))


def pushed(system: System, start: str) -> np.ndarray:
    """Angles beyond its limits (2 n, steps) of each joint under its full gear alone.

    Args:
        system: The robot.
        start: Where the joint is at rest first: in the ``"default"`` pose, on the
            ``"same"`` limit, or on the ``"other"`` one.
    """
    steps = round(SECONDS / system.robot.dt)
    limited = np.flatnonzero(system.limit_stiffness[system.control_dof])
    rows = [(side, joint) for joint in limited for side in (-1.0, 1.0)]
    q = np.tile(system.rest_q, (len(rows), 1))
    controls = np.zeros((len(rows), steps, system.nu))
    at, limit = [], []
    for row, (side, joint) in enumerate(rows):
        dof = system.control_dof[joint]
        at.append(int(system.q_start[system.v_start == dof][0]))
        limits = system.limit_lower[dof], system.limit_upper[dof]
        here, there = limits if side < 0 else limits[::-1]
        limit.append(here)
        controls[row, :, joint] = side
        q[row, at[row]] = {"default": q[row, at[row]], "same": here, "other": there}[
            start
        ]
    still = np.zeros((len(rows), system.nv))
    states = (x.astype(np.float32) for x in (q, still, controls))
    path = np.asarray(rollouts(system)(*states).q)
    angles = path[np.arange(len(rows)), :, at]
    return np.array([side for side, _ in rows])[:, None] * (
        angles - np.array(limit)[:, None]
    )


@pytest.mark.parametrize("name", LIMITED)
def test_full_gear_is_held_at_the_stated_angle(name: str) -> None:
    system = floating(name)
    material = system.robot.material
    for start in ("default", "same", "other"):
        beyond = pushed(system, start)
        report(f"peak beyond the limit from {start} [rad]", beyond.max())
        assert beyond.max() < material.limit_swing
        if start != "other":  # a joint that swings for long is not still yet
            np.testing.assert_allclose(
                beyond[:, -1], material.limit_overshoot, rtol=0.02
            )
