"""Contact of two moving bodies: momentum, rest, friction, gradients."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest
from moving_bodies import ball, body, crossing, rod, turning_rods, world
from physics_helpers import (
    POINTS,
    batched_step,
    directional_errors,
    functional,
    growth,
    passive,
    penetration,
    report,
    rollout,
)
from urdf_text import row, write

from newton_qd.physics.model import build_system
from newton_qd.robots import Contact, Material

# Momentum


@pytest.mark.parametrize("step", [pytest.param(0.005, marks=pytest.mark.slow), 0.01])
def test_two_balls_collide(x64: None, tmp_path: Path, step: float) -> None:
    """Off centre, masses 1 and 3: momentum is kept, energy only lost, they part."""
    balls = body("a", ball(0.1)), body("b", ball(0.1), mass=3.0)
    system = world(tmp_path, *balls, dt=step)
    mass = np.array([1.0, 1.0, 1.0, 3.0, 3.0, 3.0])
    for speed in (1.0, 10.0):
        q = np.array([-0.15, 0.0, 0.0, 0.15, 0.05, 0.02])
        v = speed * np.array([1.0, 0.0, 0.0, -0.5, 0.0, 0.0])
        path = rollout(system)(q, v, passive(system, round(0.6 / step)))
        along = np.concatenate([v[None], path.v])
        momentum = (mass * along).reshape(-1, 2, 3).sum(axis=1)
        energy = (mass * along**2).sum(axis=1)
        report("drift of momentum", np.abs(momentum - momentum[0]).max() / speed)
        report("energy kept", energy[-1] / energy[0])
        np.testing.assert_allclose(momentum - momentum[0], 0.0, atol=1e-13 * speed)
        assert energy[-1] < 0.999 * energy[0]
        assert float(path.normal_impulse.max()) > 0
        assert float(path.normal_impulse.min()) == 0.0
        q, v = np.asarray(path.q[-1]), np.asarray(path.v[-1])
        assert (q[3:] - q[:3]) @ (v[3:] - v[:3]) > 0


def test_impulse_of_a_central_hit(x64: None, tmp_path: Path) -> None:
    """The implicit law of two free bodies: J = P / (1 + W / m), m the reduced mass."""
    balls = body("a", ball(0.1)), body("b", ball(0.1), mass=3.0)
    system = world(tmp_path, *balls, gravity=9.81)
    material, h = system.robot.material, system.robot.dt
    speed, gap = 0.4, -0.03  # beyond the smoothing: x = -gap and the gate is 1
    q = np.array([0.0, 0.0, 0.0, 0.2 + gap, 0.0, 0.0])
    v = np.array([speed, 0.0, 0.0, 0.0, 0.0, 0.0])
    after = batched_step(system)(q[None], v[None], np.zeros((1, 0)))
    k = h * system.contact_stiffness * (1 + material.dissipation * speed)
    load = k * (h * speed - gap)
    # the clip at zero is smooth over half of the load
    expected = float(penetration(-load / (1 + h * k / 0.75), 0.5 * load))
    assert after[3][0, system.body_names.index("a")] == pytest.approx(expected)
    change = np.asarray(after[1][0]) - v
    assert change[0] == pytest.approx(-expected)
    assert change[3] == pytest.approx(expected / 3)
    np.testing.assert_allclose(change[[2, 5]], -9.81 * h, rtol=1e-12)


def test_free_rods_conserve_momentum(x64: None, tmp_path: Path) -> None:
    """Impulses are equal and opposite to the last digit, at one point."""
    system = turning_rods(tmp_path)
    q, v = crossing(np.random.default_rng(0), 100)
    after = batched_step(system)(q, v, np.zeros((100, 0)))
    impulse, normal = np.asarray(after[2]), np.asarray(after[3])
    a, b = (system.body_names.index(name) for name in "ab")
    report("share of the rods that touch", (normal[:, a] > 0).mean())
    assert (normal[:, a] > 0).mean() > 0.6
    np.testing.assert_array_equal(impulse[:, a, :3], -impulse[:, b, :3])
    np.testing.assert_array_equal(normal[:, a], normal[:, b])
    # each about its own centre of mass; about the origin they cancel
    spin = impulse[:, [a, b], 3:].sum(axis=1)
    spin += np.cross(q[:, :3], impulse[:, a, :3])
    spin += np.cross(q[:, 6:9], impulse[:, b, :3])
    np.testing.assert_allclose(spin, 0.0, atol=1e-13)
    change = np.asarray(after[1]) - v
    momentum = change[:, :3] + 4.0 * change[:, 6:9]
    report("change of momentum", np.abs(momentum).max())
    np.testing.assert_allclose(momentum, 0.0, atol=1e-13)
    sheared = impulse[:, a, :3]
    size = np.linalg.norm(sheared, axis=1)
    friction = np.sqrt(np.maximum(size**2 - normal[:, a] ** 2, 0.0))
    cone = system.robot.material.friction * normal[:, a]
    assert (friction <= cone * (1 + 1e-6) + 1e-12).all()


# Rest and friction


def test_ball_rests_between_two(x64: None, tmp_path: Path) -> None:
    """In the angle of two balls: each carries the weight over 2 cos(angle)."""
    slick = Material(support=1, friction=0.0)
    bodies = (
        body("a", ball(0.1), slides="xz"),
        body("b", ball(0.1), slides="z", mass=2.0),
        body("c", ball(0.1), slides="z", mass=2.0),
    )
    shifted = "".join(bodies)
    for name, x in (("b", -0.08), ("c", 0.08)):
        shifted = shifted.replace(
            f'<child link="{name}"/>',
            f'<child link="{name}"/><origin xyz="{x} 0 0"/>',
        )
    system = world(
        tmp_path,
        shifted,
        gravity=9.81,
        material=slick,
        contacts=(Contact("b"), Contact("c")),
    )
    names = system.body_names
    q = np.zeros(4)
    q[[names.index("b"), names.index("c")]] = 0.1
    q[names.index("a")] = 0.1 + 0.18
    path = rollout(system)(q, np.zeros(4), passive(system, 400))
    assert np.abs(np.asarray(path.v[-1])).max() < 1e-9
    a, b, c = (float(path.q[-1, names.index(name)]) for name in "abc")
    assert b == pytest.approx(c)
    rise = (a - b) / np.hypot(a - b, 0.08)
    weight = 9.81 * system.robot.dt
    load = np.asarray(path.normal_impulse[-1])
    assert load[names.index("a")] == pytest.approx(weight / rise, rel=1e-6)
    impulse = np.asarray(path.impulse[-1])
    assert impulse[names.index("b"), 2] == pytest.approx(2.0 * weight, rel=1e-6)
    # both contacts of b: the ground's, and half of a's
    assert load[names.index("b")] == pytest.approx(
        weight * (2.5 + 0.5 / rise), rel=1e-6
    )


@pytest.mark.parametrize("mass", [0.05, 1.0, 20.0])
@pytest.mark.parametrize("step", [0.005, 0.01])
def test_ball_on_a_sledge_neither_rings_nor_slips(
    x64: None, tmp_path: Path, mass: float, step: float
) -> None:
    """A ball on a rod that slides: friction takes both to one speed and keeps it."""
    rolling = body("a", ball(0.1), slides="xz", mass=mass)
    lying = rod(0.1, 4.0).replace(
        "<geometry>", '<origin rpy="0 1.5707963267948966 0"/><geometry>'
    )
    system = world(
        tmp_path, rolling, body("b", lying, slides="x"), gravity=9.81, dt=step
    )
    q = np.array([0.0, 0.2, 0.0])
    x, z, b = (system.body_names.index(name) for name in ("a_0", "a", "b"))
    assert (x, z, b) == (0, 1, 2)
    path = rollout(system)(q, np.array([1.0, 0.0, 0.0]), passive(system, 400))
    v = np.asarray(path.v)
    momentum = mass * v[:, 0] + v[:, 2]
    np.testing.assert_allclose(momentum, mass, rtol=1e-12)
    together = mass / (mass + 1.0)
    report("slip and height at the end", (v[-1, 0] - v[-1, 2], float(path.q[-1, 1])))
    np.testing.assert_allclose(v[-1, [0, 2]], together, atol=1e-3)
    slip = np.abs(v[:, 0] - v[:, 2])
    assert np.diff(slip).max() < 1e-9  # it only decreases
    assert abs(v[-1, 1]) < 1e-6


@pytest.mark.parametrize(
    ("masses", "step"), [((1.0, 1.0), 0.005), ((1.0, 4.0), 0.0025)]
)
def test_collisions_end_with_less_energy(
    x64: None, tmp_path: Path, masses: tuple[float, float], step: float
) -> None:
    """Rods thrown at each other at up to 5 m/s, at any angle."""
    first = body("a", rod(0.05, 0.6), "xz", "y", masses[0])
    second = body("b", rod(0.04, 0.5), "xz", "y", masses[1])
    system = world(tmp_path, first, second, dt=step)
    rng = np.random.default_rng(0)
    n = 64
    q, v = np.zeros((n, 6)), rng.normal(size=(n, 6))
    q[:, [2, 5]] = rng.uniform(-3, 3, (n, 2))
    q[:, 0] = -0.75
    q[:, 1] = rng.uniform(-0.2, 0.2, n)
    v[:, 0] += rng.uniform(1.0, 5.0, n)
    steps = round(0.4 / step)
    path = jax.vmap(lambda q, v: rollout(system)(q, v, passive(system, steps)))(q, v)
    v = np.concatenate([v[:, None], path.v], axis=1)
    inertia = np.outer(masses, [1.0, 1.0, 0.02]).ravel()
    energy = (inertia * v**2).sum(axis=2)
    kept = energy[:, -1] / energy[:, 0]
    hit = np.asarray(path.normal_impulse).max(axis=(1, 2)) > 0
    report(
        "share that hit, largest share of energy kept", (hit.mean(), kept[hit].max())
    )
    assert hit.mean() > 0.5
    assert kept.max() < 1 + 1e-9
    momentum = (inertia * v)[..., :2] + (inertia * v)[..., 3:5]
    np.testing.assert_allclose(momentum - momentum[:, :1], 0.0, atol=1e-12)


# Smoothness and gradients


def turning_past_parallel(s: np.ndarray) -> np.ndarray:
    q = np.tile([0.0, 0, 0, 0, 0, 0, 0.085, 0, 0.05, 0, 0, 0], (len(s), 1))
    q[:, 10] = 0.3 * s
    return q


def past_an_end(s: np.ndarray) -> np.ndarray:
    q = np.tile([0.0, 0, 0, 0, 0, 0, 0.08, 0, 0, 0.9, 0, 0], (len(s), 1))
    q[:, 8] = 0.3 + 0.1 * s
    return q


@pytest.mark.parametrize("line", [turning_past_parallel, past_an_end])
def test_step_is_smooth(
    x64: None, tmp_path: Path, line: Callable[[np.ndarray], np.ndarray]
) -> None:
    system = turning_rods(tmp_path)
    q = line(np.linspace(-1.0, 1.0, POINTS))
    v = np.tile(0.1 * np.random.default_rng(0).normal(size=12), (POINTS, 1))
    after = batched_step(system)(q, v, np.zeros((POINTS, 0)))
    q, v, impulse, normal, fault = (np.asarray(x) for x in after)
    assert not fault.any()
    assert (normal.max(axis=1) > 0).mean() > 0.5
    orders = [growth(x) for x in (q, v, impulse, normal)]
    report("orders", np.round(orders, 3))
    assert min(orders) > 1.9


DEGENERATE = {
    "coincident": [0.0] * 6,
    "parallel": [0.08, 0.0, 0.0, 0.0, 0.0, 0.0],
    "antiparallel": [0.08, 0.0, 0.1, 0.0, np.pi, 0.0],
    "axes cross": [0.0, 0.0, 0.0, 0.5 * np.pi, 0.0, 0.0],
    "axes cross at an end": [0.0, 0.0, 0.3, 0.5 * np.pi, 0.0, 0.0],
    "end to end": [0.0, 0.0, 0.63, 0.0, 0.0, 0.0],
    "far away": [4e3, -3e3, 1e3, 0.3, 0.4, 0.5],
}


@pytest.mark.slow
def test_degenerate_cases_are_finite(x64: None, tmp_path: Path) -> None:
    """Values and gradients, at rest and moving."""
    system = turning_rods(tmp_path)
    q = np.zeros((2 * len(DEGENERATE), 12))
    q[:, 6:] = np.repeat(list(DEGENERATE.values()), 2, axis=0)
    v = np.zeros_like(q)
    v[1::2] = np.random.default_rng(0).normal(size=12)
    value = functional(system, 1)
    gradient = jax.vmap(jax.grad(lambda q, v: value(q, v, np.zeros(0)), (0, 1)))(q, v)
    after = batched_step(system)(q, v, np.zeros((len(q), 0)))
    for found in (*after, *gradient):
        assert np.isfinite(np.asarray(found)).all()
    assert not np.asarray(after[4]).any()


@pytest.mark.slow
@pytest.mark.parametrize(("steps", "bound"), [(1, 1e-6), (8, 1e-4)])
def test_directional_derivatives(
    x64: None, tmp_path: Path, steps: int, bound: float
) -> None:
    system = turning_rods(tmp_path)
    q, v = crossing(np.random.default_rng(0), 60)
    normal = np.asarray(batched_step(system)(q, v, np.zeros((60, 0)))[3])
    touching = normal.max(axis=1) > 0
    report("share that touch", touching.mean())
    assert touching.mean() > 0.5
    value = functional(system, steps)
    errors = directional_errors(lambda q, v: value(q, v, np.zeros(0)), (q, v))
    report("largest error for q, v", errors.max(axis=1))
    assert errors.max() < bound


# What else holds


def test_partner_that_cannot_move_is_a_wall(x64: None, tmp_path: Path) -> None:
    """Against a rod of 1e9 times the mass a step is the one at a static capsule."""
    tilted = rod(0.05, 0.6).replace("<geometry>", '<origin rpy="0.9 0.4 0"/><geometry>')
    system = world(tmp_path, body("a", tilted), body("b", rod(0.04, 0.5)))
    a, b = (system.body_names.index(name) for name in "ab")
    first = int(np.flatnonzero(system.contact_body == a)[0])
    mass = np.where(np.arange(system.nb) == b, 1e9, 1.0) * system.mass
    heavy = dataclasses.replace(
        system,
        mass=mass,
        contact_pairs=np.array([[first, 1 - first]], np.int32),
    )
    walled = dataclasses.replace(
        heavy,
        contact_body=system.contact_body[[first]],
        contact_obstacle=np.zeros(1, np.int32),
        contact_position=system.contact_position[[first]],
        contact_segment=system.contact_segment[[first]],
        contact_radius=system.contact_radius[[first]],
        contact_pairs=np.zeros((0, 2), np.int32),
        obstacle_kind=np.array([1], np.int32),
        obstacle_frame=np.array([[0.0, 0, 0, 0, 0, 0, 1]]),
        obstacle_size=np.array([[0.04, 0.25, 0.0]]),
    )
    rng = np.random.default_rng(0)
    n = 50
    q, v = np.zeros((2, n, 6))
    q[:, :3] = rng.uniform(-1, 1, (n, 3)) * np.array([0.12, 0.12, 0.4])
    v[:, :3] = rng.normal(size=(n, 3))
    pair, wall = (
        np.asarray(batched_step(one)(q, v, np.zeros((n, 0)))[3])[:, a]
        for one in (heavy, walled)
    )
    assert (wall > 0).mean() > 0.5
    np.testing.assert_allclose(pair, wall, rtol=1e-6, atol=1e-12)


def test_roots_move_as_each_alone(x64: None, tmp_path: Path) -> None:
    """Two pendulums and a slide in one world, and each in a world of its own."""
    arms = {
        "a": body("a", "", slides="x", turns="y"),
        "b": body("b", "", slides="", turns="xy", mass=2.0),
        "c": body("c", "", slides="zx", turns="z", mass=0.5),
    }
    hung = {
        name: text.replace(
            f'<link name="{name}"><inertial>',
            f"""<link name="{name}">
            <inertial><origin xyz="0.1 0.2 -0.3"/>""",
        )
        for name, text in arms.items()
    }
    rng = np.random.default_rng(0)
    together = world(tmp_path, *hung.values(), gravity=9.81, pairs=())
    q, v = rng.normal(size=(2, together.nq))
    path = rollout(together)(q, v, passive(together, 50))
    for name, text in hung.items():
        folder = tmp_path / name
        folder.mkdir()
        robot = f'<robot name="one"><link name="world"/>{text}</robot>'
        own = row(write(folder, robot), name, gravity=9.81, dt=0.01, substeps=1)
        alone = build_system(own, "float64")
        at = [together.body_names.index(link) for link in alone.body_names]
        apart = rollout(alone)(q[at], v[at], passive(alone, 50))
        np.testing.assert_allclose(path.q[:, at], apart.q, rtol=1e-10, atol=1e-10)


# Tables


def test_the_sides_of_a_pair_stay_together(x64: None, tmp_path: Path) -> None:
    """Rows are sorted by body; a ball is before a rod, which has a length."""
    names = ("a", "b", "c")
    bodies = body("a", rod(0.1, 0.4)), body("b", ball(0.1)), body("c", ball(0.1))
    pairs = ("ca", "bc")
    system = world(
        tmp_path,
        *bodies,
        pairs=tuple((Contact(first), Contact(second)) for first, second in pairs),
    )
    links = [system.body_names[body] for body in system.contact_body]
    assert [name for name in links if name in names] == ["a", "b", "c", "c"]
    assert ["".join(links[row] for row in pair) for pair in system.contact_pairs] == [
        *pairs
    ]
    other = world(tmp_path, *bodies, pairs=((Contact("a"), Contact("b")),))
    first, second = other.contact_segment[other.contact_pairs[0]]
    assert not first.any() and second.any()
