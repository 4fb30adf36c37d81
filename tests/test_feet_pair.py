"""The feet of the halfcheetah, which touch each other; and pairs as data of a row."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from physics_helpers import (
    batched_step,
    directional_errors,
    functional,
    penetration,
    report,
    solved_impulse,
    variant,
)

from newton_qd import physics
from newton_qd.physics import buffers, reference
from newton_qd.physics.model import build_system
from newton_qd.physics.model.xml_reader import RobotDescriptionError
from newton_qd.physics.stepping import Solves
from newton_qd.physics.system import System
from newton_qd.robots import HALFCHEETAH, ROBOTS, Contact


def feet_gap(system: System, q: np.ndarray) -> float:
    """Gap of the two sides of a pair, by brute force [m]."""
    rows, frames = system.contact_pairs[0], reference.body_frames(system, q)
    share = np.linspace(-1, 1, 41)[:, None]
    points = []
    for side in rows:
        frame = frames[system.contact_body[side]]
        line = system.contact_position[side] + share * system.contact_segment[side]
        points.append(frame[:3] + line @ reference.rotation_matrix(frame[3:]).T)
    distance = np.linalg.norm(points[0][:, None] - points[1][None], axis=-1)
    return float(distance.min() - system.contact_radius[rows].sum())


def pressed_feet(system: System, rng: np.random.Generator, worlds: int) -> Any:
    """Halfcheetahs in the air whose feet are 3 to 15 mm deep in each other."""
    together = np.array([-0.6, -0.75, -0.35, 0.7, 0.5, 0.3])
    found = []
    while len(found) < worlds:
        apart = system.rest_q.copy()
        apart[1:3] = 1.0, rng.uniform(-0.5, 0.5)
        pressed = apart.copy()
        pressed[3:] = together + rng.uniform(-0.35, 0.35, 6)
        if feet_gap(system, pressed) > -0.015:
            continue
        depth = rng.uniform(0.003, 0.015)
        near, far = 1.0, 0.0
        for _ in range(12):
            middle = 0.5 * (near + far)
            deep = feet_gap(system, middle * pressed + (1 - middle) * apart) < -depth
            near, far = (middle, far) if deep else (near, middle)
        found.append(near * pressed + (1 - near) * apart)
    v = rng.normal(size=(worlds, system.nv))
    return np.array(found), v, rng.uniform(-1.0, 1.0, (worlds, system.nu))


@pytest.fixture
def cheetah(x64: None) -> System:
    return variant(HALFCHEETAH, "float64", dt=0.005, substeps=1, gravity=0.0)


def test_pairs_are_those_of_the_original() -> None:
    """Of the legged robots only a back and a front foot touch each other."""
    pairs = {
        robot.name: [tuple(contact.link for contact in pair) for pair in robot.pairs]
        for robot in ROBOTS.values()
        if robot.pairs and robot.feet
    }
    assert pairs == {"halfcheetah": [("bfoot", "ffoot")]}
    system = physics.load_system(HALFCHEETAH)
    (sides,) = system.contact_pairs
    names = {system.body_names[system.contact_body[side]] for side in sides}
    assert names == {"bfoot", "ffoot"}
    assert (system.contact_obstacle[sides] == -1).all()
    lengths = np.linalg.norm(system.contact_segment[sides], axis=1)
    np.testing.assert_allclose(lengths, [0.07, 0.094])
    np.testing.assert_allclose(system.contact_radius[sides], 0.046)


def test_feet_push_each_other_apart(
    cheetah: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A tree keeps its momentum too: its root's momentum is not changed.

    In one iteration: a second one has velocity products, of the velocity gained.
    """
    monkeypatch.setattr(buffers, "substep_solves", lambda _: Solves(1, 3))
    cheetah = dataclasses.replace(cheetah)  # one whose solves are not yet chosen
    q, _, u = pressed_feet(cheetah, np.random.default_rng(0), 20)
    still = np.zeros((20, cheetah.nv))
    after = batched_step(cheetah)(q, still, 0 * u)
    impulse, normal = np.asarray(after[2]), np.asarray(after[3])
    feet = [cheetah.body_names.index(name) for name in ("bfoot", "ffoot")]
    assert (normal[:, feet] > 0).all()
    np.testing.assert_array_equal(impulse[:, feet[0], :3], -impulse[:, feet[1], :3])
    for world in range(20):
        assert feet_gap(cheetah, np.asarray(after[0][world])) > feet_gap(
            cheetah, q[world]
        )
        # rows of the root's slides: linear momentum of the robot
        root = reference.mass_matrix(cheetah, q[world])[:2]
        np.testing.assert_allclose(root @ np.asarray(after[1][world]), 0.0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("step", "bound"), [(0.005, 0.07), (0.00125, 0.01)])
def test_impulse_of_feet_is_nearly_the_coupled_one(
    x64: None, step: float, bound: float
) -> None:
    """Without friction: against the law solved with both feet coupled.

    Far beyond their limits the joints of some push hard: the largest errors.
    """
    slick = dataclasses.replace(HALFCHEETAH.material, friction=0.0)
    changes = {"substeps": 1, "gravity": 0.0, "material": slick}
    system = variant(HALFCHEETAH, "float64", dt=step, **changes)
    q, v, u = pressed_feet(system, np.random.default_rng(1), 40)
    # what else changes the velocity, and how deep the kernel finds the feet
    alone = variant(HALFCHEETAH, "float64", dt=step, pairs=(), **changes)
    short = variant(HALFCHEETAH, "float64", dt=1e-9, **changes)
    v, u = 0.3 * v, 0.0 * u
    after, free, early = (
        [np.asarray(x) for x in batched_step(one)(q, speed, u)]
        for one, speed in ((system, v), (alone, v), (short, 0.0 * v))
    )
    side = system.contact_pairs[0, 0]
    foot = system.contact_body[side]
    depth = early[3][:, foot] / (1e-9 * system.contact_stiffness)
    assert (depth > 1e-3).all()
    errors = []
    for world in np.flatnonzero(after[3][:, foot] > 0):
        push = after[2][world, foot, :3]
        towards = relative_motion(system, q[world], push / np.linalg.norm(push))
        expected = coupled(
            system,
            depth[world],
            towards @ v[world],
            towards @ (free[1][world] - v[world]),
            towards @ (after[1][world] - free[1][world]) / np.linalg.norm(push),
        )
        errors.append(after[3][world, foot] / expected - 1)
    shares = [50, 75, 90]
    report(
        f"error of the impulse, percentiles {shares}",
        np.percentile(np.abs(errors), shares),
    )
    assert len(errors) > 20
    assert np.median(np.abs(errors)) < bound


def relative_motion(system: System, q: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Velocity (nv,) of the feet's contact points along ``normal``, per velocity."""
    frames = reference.body_frames(system, q)
    linear, angular = reference.jacobians(system, q)
    share = np.linspace(-1, 1, 401)[:, None]
    points = []
    for side in system.contact_pairs[0]:
        frame = frames[system.contact_body[side]]
        line = system.contact_position[side] + share * system.contact_segment[side]
        points.append(frame[:3] + line @ reference.rotation_matrix(frame[3:]).T)
    distance = np.linalg.norm(points[0][:, None] - points[1][None], axis=-1)
    first, second = np.unravel_index(distance.argmin(), distance.shape)
    point = 0.5 * (points[0][first] + points[1][second])
    rows = []
    for side in system.contact_pairs[0]:
        where = system.contact_body[side]
        frame = frames[where]
        com = frame[:3] + reference.rotation_matrix(frame[3:]) @ system.com[where]
        moved = linear[where] + np.cross(angular[where].T, point - com).T
        rows.append(normal @ moved)
    return rows[0] - rows[1]


def coupled(
    system: System, depth: float, vn: float, free: float, compliance: float
) -> float:
    """Normal impulse that solves the implicit law together with the motion.

    Args:
        system: The system.
        depth: Smooth penetration [m].
        vn: Velocity of parting [m/s].
        free: Its change without the contact [m/s].
        compliance: Its change per unit of impulse [1/kg].
    """
    width = system.robot.material.smoothing
    low, high = -1.0, width
    for _ in range(60):
        gap = 0.5 * (low + high)
        low, high = (gap, high) if penetration(gap, width) > depth else (low, gap)
    h = system.robot.dt
    return solved_impulse(system, h, low, vn, free, compliance, solves=2)


@pytest.mark.slow  # compiles the adjoint
@pytest.mark.parametrize(("steps", "bound"), [(1, 1e-6), (8, 1e-4)])
def test_directional_derivatives(cheetah: System, steps: int, bound: float) -> None:
    inputs = pressed_feet(cheetah, np.random.default_rng(0), 30)
    touching = np.asarray(batched_step(cheetah)(*inputs)[3]).max(axis=1) > 0
    report("share that touch", touching.mean())
    assert touching.mean() > 0.9
    errors = directional_errors(functional(cheetah, steps), inputs)
    report("largest error for q, v, control", errors.max(axis=1))
    assert errors.max() < bound


def test_refused_pairs() -> None:
    def refuse(message: str, *pair: Contact) -> None:
        robot = dataclasses.replace(HALFCHEETAH, pairs=(pair,))  # pyright: ignore
        with pytest.raises(RobotDescriptionError, match=message):
            build_system(robot, "float32")

    foot = Contact("bfoot")
    refuse(
        "pairs: got 'hand', .* in halfcheetah.urdf; allowed: ", foot, Contact("hand")
    )
    refuse("pairs: end of 'bfoot': got 1; allowed: 0", Contact("bfoot", 1), foot)
    refuse(
        "pairs: got 'torso', a link with 2 colliders of sphere", foot, Contact("torso")
    )
    refuse(
        "pairs: got 'torso', a link with 0 colliders 'tail' of sphere",
        foot,
        Contact("torso", collider="tail"),
    )
    refuse("pairs: got 'bfoot' and 'bfoot', .* as one body; allowed: links", foot, foot)
