"""Robots that contact is measured on: those of the suite, and a hexapod."""

from __future__ import annotations

import dataclasses
import functools
import tempfile
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from hexapod import hexapod

import newton_qd
from newton_qd import physics
from newton_qd.envs.base import PhysicsEnv
from newton_qd.physics import reference
from newton_qd.physics.model import build_system
from newton_qd.physics.model.rest import raising_coordinate
from newton_qd.physics.system import JointKind, System
from newton_qd.robots import ROBOTS

ACTIONS = ("noise", "sine", "bang-bang")
HEXAPODS = {"hexapod": 0.01, "hexapod-undamped": 0.0}  # damping [N m s/rad]
SUBJECTS = (*ROBOTS, *HEXAPODS)

Control = Callable[[physics.PhysicsState, jax.Array], jax.Array]


def one_substep(system: System) -> System:
    """The system with a control step of a single substep."""
    short = dataclasses.replace(system.robot, dt=system.h, substeps=1)
    return dataclasses.replace(system, robot=short)


def finer(system: System, factor: int) -> System:
    """The system with ``factor`` times the substeps in a control step."""
    fine = dataclasses.replace(system.robot, substeps=factor * system.substeps)
    return dataclasses.replace(system, robot=fine)


def undriven(state: physics.PhysicsState, action: jax.Array) -> jax.Array:
    """The action as the control."""
    del state
    return action


@dataclasses.dataclass(frozen=True)
class Subject:
    """A robot that is measured.

    Attributes:
        name: Name for tables.
        system: The system, in float64.
        control: Maps a state and an action to what the actuators get.
        actions: Number of actions.
        reset: Returns coordinates (n, nq) and velocities (n, nv) of n worlds.
    """

    name: str
    system: System
    control: Control
    actions: int
    reset: Callable[[int], tuple[np.ndarray, np.ndarray]]


@functools.cache
def from_suite(name: str) -> Subject:
    """An environment of the suite."""
    made = newton_qd.create(
        name, episode_length=None, auto_reset=False, dtype="float64"
    )
    env = made.unwrapped
    assert isinstance(env, PhysicsEnv)

    def reset(worlds: int) -> tuple[np.ndarray, np.ndarray]:
        keys = jax.random.split(jax.random.key(0), worlds)
        first = jax.jit(jax.vmap(env.reset))(keys).pipeline_state
        return np.asarray(first.q), np.asarray(first.v)

    return Subject(name, env.system, env.control, env.action_size, reset)


def from_system(name: str, system: System) -> Subject:
    """A robot of one's own: it begins in its default pose with noise on its joints."""

    def reset(worlds: int) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng(0)
        q = np.tile(system.rest_q, (worlds, 1))
        v = np.zeros((worlds, system.nv))
        joints = system.joint_kind != JointKind.FREE
        for at, noisy in ((system.q_start, q), (system.v_start, v)):
            columns = at[joints]
            noisy[:, columns] += rng.uniform(-0.1, 0.1, (worlds, len(columns)))
        ground(system, q, np.zeros(worlds))
        return q, v

    return Subject(name, system, undriven, system.nu, reset)


@functools.cache
def subject(name: str) -> Subject:
    """A robot of ``SUBJECTS``."""
    if name not in HEXAPODS:
        return from_suite(name)
    with tempfile.TemporaryDirectory() as folder:
        row = hexapod(Path(folder), HEXAPODS[name])
        return from_system(name, build_system(row, "float64"))


def ground(system: System, q: np.ndarray, heights: np.ndarray) -> None:
    """Moves robots (n, nq) until their lowest contacts have some heights (n,) [m]."""
    raising = raising_coordinate(system)
    if raising is None or not len(system.ground_contacts):
        return
    coordinate, sign = raising
    for row, height in zip(q, heights, strict=True):
        lowest = reference.lowest_contact(system, row)
        row[coordinate] += sign * (height - lowest)


def poses(system: System, worlds: int) -> np.ndarray:
    """Coordinates (worlds, nq) for drops: any joint angles, any attitude.

    The lowest contact is 0.05 to 0.5 m above the ground.
    """
    rng = np.random.default_rng(1)
    q = np.tile(system.rest_q, (worlds, 1))
    for body, kind in enumerate(system.joint_kind):
        at, dof = system.q_start[body], system.v_start[body]
        if kind == JointKind.FREE:
            turn = rng.normal(size=(worlds, 4))
            turn /= np.linalg.norm(turn, axis=1, keepdims=True)
            q[:, at + 3 : at + 7] = turn
            continue
        lower, upper = system.limit_lower[dof], system.limit_upper[dof]
        if np.isfinite(lower) and np.isfinite(upper):
            q[:, at] = rng.uniform(lower, upper, worlds)
        elif kind == JointKind.REVOLUTE:
            q[:, at] = rng.uniform(-np.pi, np.pi, worlds)
    ground(system, q, rng.uniform(0.05, 0.5, worlds))
    return q


def motion(
    kind: str, rng: np.random.Generator, steps: int, worlds: int, size: int, dt: float
) -> np.ndarray:
    """Actions (steps, worlds, size) between -1 and 1.

    Args:
        kind: ``noise``: uniform and new in each control step. ``sine``: a gait of one
            frequency from 0.5 to 4 Hz in each world, each actuator with a phase and an
            amplitude of its own. ``bang-bang``: -1 or 1, new in each control step.
        rng: Random numbers.
        steps: Control steps.
        worlds: Worlds.
        size: Actuators.
        dt: Duration of a control step [s].
    """
    shape = (steps, worlds, size)
    if kind == "noise":
        return rng.uniform(-1.0, 1.0, shape)
    if kind == "bang-bang":
        return rng.choice([-1.0, 1.0], shape)
    assert kind == "sine"
    time = dt * np.arange(steps)[:, None, None]
    frequency = rng.uniform(0.5, 4.0, (1, worlds, 1))
    phase = rng.uniform(0.0, 1.0, (1, worlds, size))
    amplitude = rng.uniform(0.0, 1.0, (1, worlds, size))
    return amplitude * np.sin(2 * np.pi * (frequency * time + phase))
