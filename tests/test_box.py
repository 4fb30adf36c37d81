"""Contact with boxes: distances, smoothness, gradients, and what a wall holds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest
from nearest_measured import PACK, Measured
from physics_helpers import (
    POINTS,
    batched_step,
    directional_errors,
    functional,
    growth,
    passive,
    report,
    rollout,
)
from urdf_text import row, write

from newton_qd import physics
from newton_qd.physics import reference
from newton_qd.physics.system import ObstacleKind, System
from newton_qd.robots import Contact, Material
from newton_qd.scenes import Scene

ROD_RADIUS, ROD_HALF = 0.08, 0.3  # [m]
_RODS = f"""<robot name="rod"><link name="rod"><inertial><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><capsule radius="{ROD_RADIUS}" height="{2 * ROD_HALF}"/>
</geometry></collision></link></robot>"""
_BALL = """<robot name="ball"><link name="ball"><inertial><mass value="10"/>
<inertia ixx="0.25" iyy="0.25" izz="0.25" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><sphere radius="0.25"/></geometry></collision></link></robot>"""


def box_scene(
    folder: Path, size: str, origin: str = "0 0 0", rpy: str = "0 0 0"
) -> Scene:
    """A scene of one box."""
    path = folder / "box.urdf"
    path.write_text(
        f"""<robot name="scene"><link name="box"><collision>
        <origin xyz="{origin}" rpy="{rpy}"/><geometry><box size="{size}"/></geometry>
        </collision></link></robot>"""
    )
    return Scene("box", str(path))


def rod_system(folder: Path, size: str, origin: str = "0 0 0") -> System:
    """A free capsule along its z axis, and a box."""
    ends = (Contact("rod", 1), Contact("rod", -1))
    rod = row(write(folder, _RODS), "rod", contacts=ends, dt=0.01, substeps=1)
    return physics.load_system(rod, "float64", box_scene(folder, size, origin))


def ball_system(folder: Path, dtype: str, scene: Scene) -> System:
    """A ball of 10 kg that its own weight presses in by 3 mm."""
    material = Material(support=1)
    ball = row(
        write(folder, _BALL),
        "ball",
        contacts=(Contact("ball"),),
        dt=0.01,
        substeps=1,
        material=material,
    )
    return physics.load_system(ball, dtype, scene)


# Distances

# of a plate, on which nothing is thrown
THIN = pytest.mark.filterwarnings("ignore::newton_qd.physics.SoftWallWarning")


def box_distance(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Signed distance (...,) of points (..., 3) from a box."""
    over = np.abs(points) - half
    outside = np.linalg.norm(np.maximum(over, 0.0), axis=-1)
    return outside + np.minimum(over.max(axis=-1), 0.0)


def contact_with_box(system: System) -> int:
    return int(np.flatnonzero(system.contact_obstacle == 1)[0])


SIZES = ["1.0 0.8 0.6", "2.0 3.0 0.2", "0.02 1.0 1.0"]


@THIN
@pytest.mark.parametrize("size", SIZES)
def test_nearest_points(x64: None, tmp_path: Path, size: str) -> None:
    system = rod_system(tmp_path, size)
    half = system.obstacle_size[1]
    assert system.obstacle_kind.tolist() == [ObstacleKind.PLANE, ObstacleKind.BOX]
    np.testing.assert_allclose(half, np.array(size.split(), float) / 2)
    rng = np.random.default_rng(0)
    n = 4000
    at = rng.uniform(-1.0, 1.0, (n, 3)) * (half + 0.5)
    at[-n // 8 :] *= 5.0  # beyond 1.1 m, no nearest point is searched
    along = rng.normal(size=(n, 3))
    along[: n // 4, :2] *= 0.02  # nearly parallel to the faces
    along[n // 4 : n // 2, 1:] *= 0.02
    along *= ROD_HALF / np.linalg.norm(along, axis=1, keepdims=True)
    share = np.linspace(-1.0, 1.0, 801)[:, None]
    points = at[:, None] + share * along[:, None]
    exact = box_distance(points, half).min(axis=1)
    found = Measured(tmp_path, system, contact_with_box(system), at, along)
    near = np.abs(exact - ROD_RADIUS) < 0.03
    excess = (found.distance - exact)[near]
    report(
        "excess of the distance, mean and largest [m]", (excess.mean(), excess.max())
    )
    assert near.sum() > 200
    assert excess.min() > -1e-6  # grid of the brute force
    assert excess.max() < 0.5 * system.robot.material.smoothing
    assert np.median(excess) < 1e-4
    beyond = exact > ROD_RADIUS + 1.1
    assert beyond.sum() > 200
    excess = (found.distance - exact)[beyond]
    assert -1e-3 < excess.min() and excess.max() < 2 * ROD_HALF
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1, atol=1e-6)
    assert np.abs(found.share).max() <= 1.0


@THIN
@pytest.mark.parametrize("size", SIZES)
def test_nearest_point_of_a_sphere(x64: None, tmp_path: Path, size: str) -> None:
    """Exact on faces and about edges; inside, the depth below the nearest face."""
    system = rod_system(tmp_path, size)
    half, smoothing = system.obstacle_size[1], system.robot.material.smoothing
    rng = np.random.default_rng(1)
    at = rng.uniform(-1.0, 1.0, (4000, 3)) * (half + 0.3)
    found = Measured(tmp_path, system, contact_with_box(system), at, np.zeros_like(at))
    assert not found.share.any()
    exact = box_distance(at, half)
    excess = found.distance - exact
    outside = exact > 1.5 * smoothing
    report("excess outside, inside [m]", (excess[outside].max(), excess.max()))
    assert np.abs(excess[outside]).max() < 0.02 * smoothing
    assert excess.min() > -1e-9
    assert excess.max() < 0.4 * smoothing
    clamped = np.clip(at, -half, half)
    normal = (at - clamped)[outside] / exact[outside, None]
    assert np.abs(found.normal[outside] - normal).max() < 0.15
    # where no other face is near
    flat = outside & (np.abs(np.abs(at) - half) > smoothing).all(axis=1)
    assert flat.sum() > 500
    np.testing.assert_allclose(found.distance[flat], exact[flat], atol=1e-8)


DEGENERATE = {
    "in the middle": ([0.0, 0.0, 0.0], [0.0, 0.0, 1.0]),
    "through the middle, along a diagonal": ([0.0, 0.0, 0.0], [0.6, 0.0, 0.8]),
    "inside, as near to two faces": ([0.4, 0.3, 0.0], [0.0, 0.0, 1.0]),
    "on a face": ([0.0, 0.0, 0.3], [1.0, 0.0, 0.0]),
    "along an edge": ([0.5, 0.4, 0.0], [0.0, 0.0, 1.0]),
    "end on a corner": ([0.5, 0.4, 0.3 + ROD_HALF], [0.0, 0.0, 1.0]),
    "flat over a face": ([0.1, 0.0, 0.38], [1.0, 0.0, 0.0]),
    "far away": ([4e4, -3e4, 1e4], [0.6, 0.0, 0.8]),
}


@pytest.mark.parametrize("case", DEGENERATE)
@pytest.mark.parametrize("length", [0.0, ROD_HALF])
def test_degenerate_cases_are_finite(
    x64: None, tmp_path: Path, case: str, length: float
) -> None:
    system = rod_system(tmp_path, "1.0 0.8 0.6")
    at, axis = (np.tile(x, (PACK, 1)) for x in DEGENERATE[case])
    found = Measured(tmp_path, system, contact_with_box(system), at, length * axis)
    for values in (found.share, found.distance, found.normal, found.slopes):
        assert np.isfinite(values).all()
    if case == "flat over a face":
        np.testing.assert_allclose(found.share, 0.0, atol=1e-12)
        np.testing.assert_allclose(found.distance, 0.08, atol=1e-9)


# Smoothness and gradients


def turned(axis: list[float], angles: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Rotations (n, 4): ``first``, then by angles about an axis."""
    turns = (reference.axis_quaternion(np.array(axis), angle) for angle in angles)
    return np.array([reference.quaternion_product(turn, first) for turn in turns])


LYING = reference.axis_quaternion(np.array([0.0, 1.0, 0.0]), np.pi / 2)  # z to x


def tipping(s: np.ndarray) -> np.ndarray:
    """A rod that lies on the top, 5 mm deep, and tips past parallel."""
    place = np.tile([0.1, 0.05, 0.3 + ROD_RADIUS - 0.005], (len(s), 1))
    return np.concatenate([place, turned([0.0, 1.0, 0.0], 0.3 * s, LYING)], axis=1)


def over_an_edge(s: np.ndarray) -> np.ndarray:
    """A rod across an edge that is shifted until its end leaves the top."""
    place = np.stack([0.6 + 0.3 * s, 0 * s + 0.05, 0 * s + 0.37], axis=1)
    return np.concatenate([place, turned([0.0, 1.0, 0.0], 0 * s + 0.1, LYING)], axis=1)


def round_a_corner(s: np.ndarray) -> np.ndarray:
    """A rod on end that goes round a corner of the box."""
    angle = 0.25 * np.pi + 0.25 * np.pi * s
    place = np.stack(
        [
            0.5 + 0.07 * np.cos(angle),
            0.4 + 0.07 * np.sin(angle),
            0.35 + ROD_HALF + 0 * s,
        ],
        axis=1,
    )
    return np.concatenate([place, turned([1.0, 0.0, 0.0], 0.1 * s, np.eye(4)[3])], 1)


@pytest.mark.parametrize(
    "line",
    [
        pytest.param(tipping, marks=pytest.mark.slow),
        pytest.param(over_an_edge, marks=pytest.mark.slow),
        pytest.param(round_a_corner, marks=pytest.mark.slow),
    ],
)
def test_step_is_smooth(
    x64: None, tmp_path: Path, line: Callable[[np.ndarray], np.ndarray]
) -> None:
    """Second differences shrink with the square of the distance."""
    system = rod_system(tmp_path, "1.0 0.8 0.6")
    q = line(np.linspace(-1.0, 1.0, POINTS))
    v = np.tile(0.1 * np.random.default_rng(0).normal(size=6), (POINTS, 1))
    after = batched_step(system)(q, v, np.zeros((POINTS, 0)))
    q, v, impulse, normal, fault = (np.asarray(x) for x in after)
    assert not fault.any()
    report("share of the points that touch", (normal > 0).mean())
    assert (normal > 0).mean() > 0.5
    orders = [growth(x) for x in (q, v, impulse, normal)]
    report("orders", np.round(orders, 3))
    assert min(orders) > 1.9


@pytest.mark.slow
@pytest.mark.parametrize(("steps", "bound"), [(1, 1e-6), (8, 1e-4)])
def test_directional_derivatives(
    x64: None, tmp_path: Path, steps: int, bound: float
) -> None:
    """Rods that touch a box anywhere, with any direction."""
    system = rod_system(tmp_path, "1.0 0.8 0.6", "0 0 2")
    half, middle = system.obstacle_size[1], np.array([0.0, 0.0, 2.0])
    rng = np.random.default_rng(0)
    n = 100
    rotation = rng.normal(size=(n, 4))
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    away = rng.normal(size=(n, 3))
    axes = np.array([reference.rotation_matrix(r)[:, 2] for r in rotation])
    share = np.linspace(-1.0, 1.0, 201)[:, None] * ROD_HALF
    near, far = np.zeros(n), np.full(n, 3.0)
    for _ in range(40):  # until it is 5 mm deep
        distance = 0.5 * (near + far)
        points = (distance[:, None] * away)[:, None] + share * axes[:, None]
        deep = box_distance(points, half).min(axis=1) < ROD_RADIUS - 0.005
        near, far = np.where(deep, distance, near), np.where(deep, far, distance)
    q = np.concatenate([middle + near[:, None] * away, rotation], axis=1)
    v = rng.normal(size=(n, 6))
    v[:, :3] -= away / np.linalg.norm(away, axis=1, keepdims=True)
    inputs = (q, v, np.zeros((n, 0)))
    touching = np.asarray(batched_step(system)(*inputs)[3])[:, 0] > 0
    report("share of the rods that touch", touching.mean())
    assert touching.mean() > 0.8
    value = functional(system, steps)
    errors = directional_errors(lambda q, v: value(q, v, np.zeros(0)), inputs[:2])
    report("largest error for q, v", errors.max(axis=1))
    assert errors.max() < bound


# What boxes hold


@pytest.mark.slow  # compiles a kernel of its own
@pytest.mark.parametrize("rpy", ["0 0 0", "0 0 0.5"])
def test_ball_rests_on_a_box(x64: None, tmp_path: Path, rpy: str) -> None:
    scene = box_scene(tmp_path, "1 1 0.4", "2 0 0.2", rpy)
    system = ball_system(tmp_path, "float64", scene)
    q = np.array([2.1, 0.1, 0.65, 0, 0, 0, 1])
    path = rollout(system)(q, np.zeros(6), passive(system, 200))
    material = system.robot.material
    depth = 0.65 - float(path.q[-1, 2])
    # as on the plane: the smooth penetration is the stated one
    u = material.smoothing + depth
    smooth = u**3 * (3 * material.smoothing - depth) / (16 * material.smoothing**3)
    assert smooth == pytest.approx(material.static_penetration, rel=1e-6)
    np.testing.assert_allclose(path.q[-1, :2], q[:2], atol=1e-9)


@pytest.mark.slow
def test_ball_never_passes_a_box_wall(tmp_path: Path) -> None:
    """Shots at a wall of 0.2 m, at its faces, ends and top."""
    scene = box_scene(tmp_path, "0.2 4 1", "3 0 0.5")
    system = ball_system(tmp_path, "float32", scene)
    grid = np.meshgrid(
        [-1.0, 1.0],
        np.radians([-85, -60, -30, 0, 30, 60, 85]),
        [0.3, 3.0, 10.0],
        [0.25, 0.5, 0.9],
        [-1.97, -1.0, 0.0],
    )
    side, angle, speed, height, along = (x.ravel() for x in grid)
    n = len(side)
    q, v = np.zeros((n, 7)), np.zeros((n, 6))
    q[:, 0], q[:, 1], q[:, 2], q[:, 6] = 3 + 0.5 * side, along, height, 1
    v[:, 0], v[:, 1] = -side * speed * np.cos(angle), speed * np.sin(angle)
    run = jax.vmap(lambda q, v: rollout(system)(q, v, passive(system, 60)))
    path = run(q.astype(np.float32), v.astype(np.float32))
    position = np.asarray(path.q, np.float64)[..., :3]
    assert np.isfinite(position).all()
    beside = (np.abs(position[..., 1]) < 2) & (position[..., 2] < 1)
    distance = np.where(beside, side[:, None] * (position[..., 0] - 3), np.inf)
    report("balls, least distance from the middle [m]", (n, distance.min()))
    assert distance.min() > 0.1
    hit = (np.asarray(path.normal_impulse)[..., 0] > 0.1).any(axis=1)
    assert hit.mean() > 0.9


@pytest.mark.slow  # the same kernel
def test_rod_never_passes_a_box_wall(x64: None, tmp_path: Path) -> None:
    """Thrown at it like a spear, at up to 10 m/s: its centre stays before it."""
    system = rod_system(tmp_path, "0.2 4 2", "0 0 1")
    speed, tilt = (x.ravel() for x in np.meshgrid([1.0, 5.0, 10.0], [0.0, 0.3, 0.8]))
    n = len(speed)
    v = np.zeros((n, 6))
    v[:, 0] = speed
    q = np.tile([-0.6, 0.0, 1.0, 0, 0, 0, 1], (n, 1))
    q[:, 3:] = turned([0.0, 1.0, 0.0], tilt, LYING)
    path = jax.vmap(lambda q, v: rollout(system)(q, v, passive(system, 40)))(q, v)
    x = np.asarray(path.q)[..., 0]
    report("rods, largest x of the centre [m]", (n, x.max()))
    assert np.isfinite(x).all()
    assert x.max() < -0.1
