"""Nearest points of capsules: against brute force, and where they are not unique."""

from __future__ import annotations

import functools
import importlib
import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp
from physics_helpers import nearest, report

from newton_qd import physics
from newton_qd.physics.buffers import build_model
from newton_qd.physics.precision import kernels
from newton_qd.physics.system import System
from newton_qd.robots import ANT
from newton_qd.scenes import TRAP

PACK = 4  # worlds of a pack in float64 on a CPU

# Nearest points

_KERNEL = """
import warp as wp

@wp.kernel
def measure(m: MODEL, c: int, o: int, at: wp.array(dtype=VEC3),
            along: wp.array(dtype=VEC3), y: wp.array(dtype=REAL)):
    i = wp.tid()
    s = nearest_share(m, c, o, at[i], along[i])
    touch = at[i] + s * along[i]
    n = obstacle_normal(m, o, touch)
    y[5 * i] = s
    y[5 * i + 1] = obstacle_distance(m, o, touch)
    y[5 * i + 2] = component(n, 0)
    y[5 * i + 3] = component(n, 1)
    y[5 * i + 4] = component(n, 2)
"""


@functools.cache
def measuring(folder: Path) -> Any:
    """A kernel of the geometry alone."""
    space = kernels("float64", PACK)
    package = space.package
    nearest = importlib.import_module(f"{package.__name__}.nearest")
    path = folder / "measure.py"
    path.write_text(_KERNEL)
    spec = importlib.util.spec_from_file_location("measure", path)
    assert spec is not None and spec.loader is not None
    module: Any = importlib.util.module_from_spec(spec)
    module.MODEL, module.VEC3 = space.structs.Model, package.vec3
    module.REAL = package.real
    for name in ("nearest_share", "obstacle_normal", "obstacle_distance"):
        setattr(module, name, getattr(nearest, name))
    for name in ("add", "mul", "component"):
        setattr(module, name, getattr(nearest, name, None) or nearest.mul)
    spec.loader.exec_module(module)
    return module.measure


def packed(values: np.ndarray, kind: Any) -> Any:
    """Vectors (n, 3) as packs on the CPU."""
    packs = values.reshape(-1, PACK, 3).swapaxes(1, 2)
    return wp.array(packs, dtype=kind, device="cpu", requires_grad=True)


class Measured:
    """Shares (n,), distances (n,) and normals (n, 3), and their adjoints."""

    def __init__(
        self, folder: Path, system: System, contact: int, at: Any, along: Any
    ) -> None:
        kernel = measuring(folder)
        package = kernels("float64", PACK).package
        held = [packed(at, package.vec3), packed(along, package.vec3)]
        packs = len(at) // PACK
        y = wp.zeros(5 * packs, dtype=package.real, device="cpu", requires_grad=True)
        model = build_model(system, wp.get_device("cpu"))
        obstacle = int(system.contact_obstacle[contact])
        inputs = [model, contact, obstacle, *held, y]
        wp.launch(kernel, packs, inputs, device="cpu")
        rows = y.numpy().reshape(packs, 5, PACK).swapaxes(1, 2).reshape(-1, 5)
        self.share, self.distance, self.normal = rows[:, 0], rows[:, 1], rows[:, 2:]
        y.grad.fill_(1.0)
        unused: list[Any] = [model, *[None] * (len(inputs) - 1)]
        wp.launch(kernel, packs, inputs, adj_inputs=unused, adjoint=True, device="cpu")
        self.slopes = np.stack([x.grad.numpy() for x in held])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(tmp_path_factory.mktemp("walls"))


def trap_of_the_ant() -> tuple[System, int, int]:
    """System, and the contacts of torso and a foot with the back wall."""
    system = physics.load_system(ANT, "float64", TRAP)
    back = np.flatnonzero(system.contact_obstacle == 1)
    return system, int(back[0]), int(back[1])


def test_nearest_points(x64: None, folder: Path) -> None:
    system, _, foot = trap_of_the_ant()
    radius, half = system.obstacle_size[1, :2]
    length = np.linalg.norm(system.contact_segment[foot])
    rng = np.random.default_rng(0)
    n = 8000
    # all about the wall: beside it, at its ends, and through its surface
    at = rng.uniform(-1.0, 1.0, (n, 3)) * np.array([1.5, 1.5, half + 1.0])
    along = rng.normal(size=(n, 3))
    along[: n // 4, :2] *= 0.02  # nearly parallel
    along *= length / np.linalg.norm(along, axis=1, keepdims=True)
    exact = nearest(at, along, half)
    # about touching: deeper inside, the distance is regularised more
    near = np.abs(exact - radius - system.contact_radius[foot]) < 0.1
    found = Measured(folder, system, foot, at, along)
    excess = (found.distance + radius - exact)[near]
    smoothing = system.robot.material.smoothing
    report(
        "excess of the distance, mean and largest [m]", (excess.mean(), excess.max())
    )
    assert near.sum() > 300
    assert excess.min() > -1e-6  # grid of the brute force, SHORTEST
    assert excess.max() < 0.3 * smoothing
    assert np.median(excess) < 1e-5
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1)[near], 1, atol=1e-9)
    assert np.abs(found.share).max() <= 1.0


def test_nearest_point_of_a_sphere(x64: None, folder: Path) -> None:
    system, torso, _ = trap_of_the_ant()
    radius, half = system.obstacle_size[1, :2]
    rng = np.random.default_rng(1)
    at = rng.uniform(-1.0, 1.0, (2000, 3)) * np.array([1.5, 1.5, half + 1.0])
    found = Measured(folder, system, torso, at, np.zeros_like(at))
    assert not found.share.any()
    flat = np.stack([at[:, 0], at[:, 1], at[:, 2] - np.clip(at[:, 2], -half, half)], 1)
    distance = np.linalg.norm(flat, axis=1)
    # rounded where the axis ends, exact elsewhere
    clear = np.abs(np.abs(at[:, 2]) - half) > system.robot.material.smoothing
    clear &= distance > 0.1
    assert clear.sum() > 1000
    np.testing.assert_allclose(
        found.distance[clear], distance[clear] - radius, atol=1e-8
    )
    normal = flat[clear] / distance[clear, None]
    np.testing.assert_allclose(found.normal[clear], normal, atol=1e-6)
    near = np.abs(distance - radius) < 0.4
    assert np.abs(found.distance + radius - distance)[near].max() < 1e-4


DEGENERATE = {
    "parallel": ([0.6, 0.0, 0.1], [0.0, 0.0, 1.0]),
    "antiparallel at an end": ([0.6, 0.0, 2.0], [0.0, 0.0, -1.0]),
    "on the axis": ([0.0, 0.0, 0.1], [0.0, 0.0, 1.0]),
    "crossing the axis": ([0.0, 0.0, 0.1], [1.0, 0.0, 0.0]),
    "centre at an end": ([0.0, 0.0, 2.0], [0.6, 0.8, 0.0]),
    "beyond the end": ([0.0, 0.0, 2.5], [0.0, 0.0, 1.0]),
    "far away": ([4e4, -3e4, 1e4], [0.6, 0.0, 0.8]),
}


@pytest.mark.parametrize("case", DEGENERATE)
@pytest.mark.parametrize("which", ["torso", "foot"])
def test_degenerate_cases_are_finite(
    x64: None, folder: Path, case: str, which: str
) -> None:
    system, torso, foot = trap_of_the_ant()
    at, axis = (np.tile(x, (PACK, 1)) for x in DEGENERATE[case])
    length = 0.0 if which == "torso" else 0.28
    contact = torso if which == "torso" else foot
    found = Measured(folder, system, contact, at, length * axis)
    for values in (found.share, found.distance, found.normal, found.slopes):
        assert np.isfinite(values).all()
    if case == "parallel":
        np.testing.assert_allclose(found.share, 0.0, atol=1e-12)
        np.testing.assert_allclose(found.distance, 0.1, atol=1e-9)
