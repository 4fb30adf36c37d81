"""Contact with walls: smoothness, gradients, and what holds robots."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics_helpers import (
    POINTS,
    batched_step,
    directional_errors,
    functional,
    growth,
    nearest,
    passive,
    report,
    rollout,
)
from urdf_text import row, write

from newton_qd import physics
from newton_qd.physics import reference
from newton_qd.physics.system import System
from newton_qd.robots import ANT, Contact, Material, RobotSpec
from newton_qd.scenes import MAZE, TRAP, Scene

# Smoothness and gradients


def facing(system: System, rng: np.random.Generator, worlds: int) -> tuple[Any, ...]:
    """Ants (n, ...) that touch the back wall of the trap with a foot or the torso."""
    q = np.tile(system.rest_q, (worlds, 1))
    q[:, 7:] += rng.uniform(-0.3, 0.3, (worlds, 8))
    turn = rng.uniform(-np.pi, np.pi, worlds)
    q[:, 5], q[:, 6] = np.sin(turn / 2), np.cos(turn / 2)
    q[:, 1] = rng.uniform(-2.4, 2.4, worlds)
    q[:, 2] += rng.uniform(0.05, 0.4, worlds)
    # as near as the deepest of its contacts is 10 mm in the wall
    plane = 12.0
    for world in range(worlds):
        low, high = plane - 2.5, plane
        for _ in range(40):
            q[world, 0] = 0.5 * (low + high)
            if wall_gap(system, q[world]) < -0.01:
                high = q[world, 0]
            else:
                low = q[world, 0]
    v = rng.normal(size=(worlds, system.nv))
    v[:, 0] = np.abs(v[:, 0])
    return q, v, rng.uniform(-1.0, 1.0, (worlds, system.nu))


def wall_gap(system: System, q: np.ndarray) -> float:
    """Smallest gap of the robot and the walls, by brute force [m]."""
    frames = reference.body_frames(system, q)
    gaps = []
    for c in np.flatnonzero(system.contact_obstacle):
        frame, o = frames[system.contact_body[c]], system.contact_obstacle[c]
        turn = reference.rotation_matrix(frame[3:])
        centre = frame[:3] + turn @ system.contact_position[c]
        wall = reference.rotation_matrix(system.obstacle_frame[o, 3:])
        at = (centre - system.obstacle_frame[o, :3]) @ wall
        along = turn @ system.contact_segment[c] @ wall
        radius, half, _ = system.obstacle_size[o]
        distance = nearest(at[None], along[None], half)[0]
        gaps.append(distance - radius - system.contact_radius[c])
    return min(gaps)


@pytest.mark.slow
@pytest.mark.parametrize(("steps", "bound"), [(1, 1e-6), (8, 1e-4)])
def test_directional_derivatives(x64: None, steps: int, bound: float) -> None:
    system = physics.load_system(ANT, "float64", TRAP)
    inputs = facing(system, np.random.default_rng(0), 50)
    after = batched_step(system)(*inputs)
    pushed = -np.asarray(after[2])[:, :, 0].sum(axis=1)
    report("share of the ants that the wall pushes back", (pushed > 0.1).mean())
    assert (pushed > 0.1).mean() > 0.7
    errors = directional_errors(functional(system, steps), inputs)
    report("largest error for q, v, control", errors.max(axis=1))
    assert errors.max() < bound


CAPSULE = """<robot name="rod"><link name="rod"><inertial><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><capsule radius="0.08" height="0.6"/></geometry></collision>
</link></robot>"""


def rod_system(folder: Path) -> System:
    """A free capsule of half length 0.3 m along its z axis, beside the trap."""
    robot = row(
        write(folder, CAPSULE),
        "rod",
        contacts=(Contact("rod", 1), Contact("rod", -1)),
        dt=0.01,
        substeps=1,
    )
    return physics.load_system(robot, "float64", TRAP)


def upright(angle: np.ndarray, axis: list[float]) -> np.ndarray:
    """Rotations (n, 4) by angles about an axis."""
    return np.array([reference.axis_quaternion(np.array(axis), a) for a in angle])


def turning(s: np.ndarray) -> np.ndarray:
    """A rod that lies along the back wall and turns past parallel."""
    first = reference.axis_quaternion(np.array([1.0, 0.0, 0.0]), np.pi / 2)
    turns = upright(0.3 * s, [0.0, 0.0, 1.0])
    turned = np.array([reference.quaternion_product(t, first) for t in turns])
    place = np.tile([12.0 - 0.575, 0.3, 0.5], (len(s), 1))
    return np.concatenate([place, turned], axis=1)


def rounding_the_end(s: np.ndarray) -> np.ndarray:
    """A rod that stands upright and goes along the back wall, then round its end."""
    way = 0.8 * s
    angle = np.maximum(way, 0.0) / 0.57
    place = np.stack(
        [
            12.0 - 0.57 * np.cos(angle),
            2.0 + np.minimum(way, 0.0) + 0.57 * np.sin(angle),
            np.full_like(s, 0.5),
        ],
        axis=1,
    )
    return np.concatenate([place, upright(0 * s, [1.0, 0.0, 0.0])], axis=1)


def over_the_end(s: np.ndarray) -> np.ndarray:
    """A rod along x that is shifted until its end leaves the wall's side."""
    first = reference.axis_quaternion(np.array([0.0, 1.0, 0.0]), np.pi / 2)
    place = np.stack([12.0 + 0.5 * s, 0 * s + 0.4, 0 * s + 1.07], 1)
    return np.concatenate([place, np.tile(first, (len(s), 1))], axis=1)


@pytest.mark.parametrize("line", [turning, rounding_the_end, over_the_end])
def test_step_is_smooth(
    x64: None, tmp_path: Path, line: Callable[[np.ndarray], np.ndarray]
) -> None:
    """Second differences shrink with the square of the distance."""
    system = rod_system(tmp_path)
    q = line(np.linspace(-1.0, 1.0, POINTS))
    v = np.tile(0.1 * np.random.default_rng(0).normal(size=6), (POINTS, 1))
    after = batched_step(system)(q, v, np.zeros((POINTS, 0)))
    q, v, impulse, normal, fault = (np.asarray(x) for x in after)
    assert not fault.any()
    assert (normal > 0).mean() > 0.9
    orders = [growth(x) for x in (q, v, impulse, normal)]
    report("orders", np.round(orders, 3))
    assert min(orders) > 1.9


def test_impulse_at_a_wall_is_along_its_normal(x64: None, tmp_path: Path) -> None:
    """A rod that comes head-on is pushed straight back, by its nearer end."""
    system = rod_system(tmp_path)
    lying = reference.axis_quaternion(np.array([0.0, 1.0, 0.0]), np.pi / 2)
    q = np.concatenate([[12.0 - 0.5 - 0.08 - 0.3 + 0.01, 0.0, 0.5], lying])
    v = np.zeros(6)
    v[0] = 1.0
    after = batched_step(system)(q[None], v[None], np.zeros((1, 0)))
    impulse = np.asarray(after[2])[0, 0]
    normal = float(after[3][0, 0])
    assert normal > 0.1
    # what it slides down by is friction
    np.testing.assert_allclose(impulse[:2], [-normal, 0], atol=1e-4 * normal)
    assert 0 < impulse[2] < normal


# What walls hold

BALL = """<robot name="ball"><link name="ball"><inertial><mass value="10"/>
<inertia ixx="0.25" iyy="0.25" izz="0.25" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><sphere radius="0.25"/></geometry></collision></link></robot>"""
TIME = 0.6  # [s]


def ball_spec(folder: Path) -> RobotSpec:
    """A ball of 10 kg that its own weight presses in by 3 mm."""
    return row(
        write(folder, BALL),
        "ball",
        contacts=(Contact("ball"),),
        dt=0.01,
        substeps=1,
        material=Material(support=1),
    )


def shots(system: System) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Balls beside every wall: q, v, the wall (n,) and the side (n,) of each."""
    places = []
    for wall in range(1, len(system.obstacle_kind)):
        frame, half = system.obstacle_frame[wall], system.obstacle_size[wall, 1]
        axis = reference.rotation_matrix(frame[3:])[:, 2]
        across = np.array([-axis[1], axis[0], 0.0])
        for side, angle, speed, height, along in np.stack(
            np.meshgrid(
                [-1.0, 1.0],
                np.radians([-85, -60, -30, 0, 30, 60, 85]),
                [0.3, 3.0, 10.0],
                [0.25, 0.4, 0.5, 0.6],
                [-0.97, 0.0, 0.6],
            ),
            axis=-1,
        ).reshape(-1, 5):
            start = frame[:3] + side * 0.8 * across + along * half * axis
            start[2] = height
            heading = -side * np.cos(angle) * across + np.sin(angle) * axis
            places.append((start, speed * heading, wall, side))
    start, velocity, wall, side = (np.array(x) for x in zip(*places, strict=True))
    n = len(start)
    q = np.concatenate([start, np.tile([0.0, 0, 0, 1], (n, 1))], axis=1)
    return q, np.concatenate([velocity, np.zeros((n, 3))], axis=1), wall, side


def beside(system: System, wall: np.ndarray, position: np.ndarray) -> tuple[Any, Any]:
    """Distance across a wall's axis (n, t), and whether it is beside the wall."""
    turns = np.array([reference.rotation_matrix(f[3:]) for f in system.obstacle_frame])
    axis = turns[wall, :, 2]
    across = np.stack([-axis[:, 1], axis[:, 0], np.zeros(len(axis))], axis=1)
    away = position - system.obstacle_frame[wall, None, :3]
    along = np.einsum("nti,ni->nt", away, axis)
    half = system.obstacle_size[wall, 1]
    return np.einsum("nti,ni->nt", away, across), np.abs(along) < half[:, None]


@pytest.mark.parametrize("scene", [TRAP, MAZE], ids=["trap", "maze"])
def test_ball_never_passes_an_axis(tmp_path: Path, scene: Scene) -> None:
    system = physics.load_system(ball_spec(tmp_path), "float32", scene)
    assert system.contact_stiffness == pytest.approx(10 * 9.81 / 0.003)
    q, v, wall, side = shots(system)
    steps = round(TIME / system.robot.dt)
    run = jax.vmap(lambda q, v: rollout(system)(q, v, passive(system, steps)))
    path = run(q.astype(np.float32), v.astype(np.float32))
    position = np.asarray(path.q, np.float64)[..., :3]
    assert np.isfinite(position).all()
    distance, opposite = beside(system, wall, position)
    distance = np.where(opposite, side[:, None] * distance, np.inf)
    report("balls, least distance from an axis [m]", (len(q), distance.min()))
    assert distance.min() > 0.2
    hit = (np.asarray(path.normal_impulse)[..., 0] > 0.1).any(axis=1)
    assert hit.mean() > 0.9


@pytest.mark.parametrize("scene", [TRAP, MAZE], ids=["trap", "maze"])
def test_torso_never_crosses_an_axis(scene: Scene) -> None:
    """Maximal random torque for 20 s, from places beside every wall."""
    system = physics.load_system(ANT, "float32", scene)
    rng = np.random.default_rng(0)
    walls = len(system.obstacle_kind) - 1
    n, steps = 8 * walls, 400
    q = np.tile(system.rest_q, (n, 1))
    for world in range(n):
        frame = system.obstacle_frame[1 + world % walls]
        axis = reference.rotation_matrix(frame[3:])[:, 2]
        across = np.array([-axis[1], axis[0], 0.0])
        along = rng.uniform(-0.8, 0.8) * system.obstacle_size[1 + world % walls, 1]
        side = 1.7 * (-1.0) ** (world // walls)
        q[world, :2] = (frame[:3] + side * across + along * axis)[:2]
    controls = rng.choice([-1.0, 1.0], (n, steps // 4, system.nu))
    controls = np.repeat(controls, 4, axis=1).astype(np.float32)
    start = jnp.asarray(q, np.float32)
    path = jax.vmap(rollout(system))(start, jnp.zeros((n, system.nv)), controls)
    position = np.asarray(path.q, np.float64)[..., :3]
    assert np.isfinite(position).all()
    low = np.minimum(position[:, 1:, 2], position[:, :-1, 2]) < 0.75
    crossings = 0
    for wall in range(1, walls + 1):
        distance, opposite = beside(system, np.full(n, wall), position)
        changed = np.sign(distance[:, 1:]) != np.sign(distance[:, :-1])
        crossings += (changed & opposite[:, 1:] & opposite[:, :-1] & low).sum()
    touched = (np.abs(np.asarray(path.impulse)[..., :2]).max(axis=(1, 2, 3)) > 0).mean()
    report("ants, crossings, share that touched anything", (n, crossings, touched))
    assert crossings == 0


def test_back_wall_stops_an_ant_that_runs_in() -> None:
    """Thrown at the wall at 5 m/s, the ant comes to rest before its axis."""
    system = physics.load_system(ANT, "float32", TRAP)
    q = np.tile(system.rest_q, (5, 1)).astype(np.float32)
    q[:, 0] = 10.2
    q[:, 1] = np.linspace(-1.5, 1.5, 5)
    v = np.zeros((5, system.nv), np.float32)
    v[:, 0] = 5.0
    path = jax.vmap(lambda q, v: rollout(system)(q, v, passive(system, 100)))(q, v)
    x = np.asarray(path.q)[..., 0]
    assert x.max() < 12 - 0.5
    assert np.abs(np.asarray(path.v)[:, -1, :3]).max() < 0.05
    plain = physics.load_system(ANT)
    free = jax.vmap(lambda q, v: rollout(plain)(q, v, passive(plain, 100)))(q, v)
    assert np.asarray(free.q)[..., 0].max() > x.max() + 0.2
