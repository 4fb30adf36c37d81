"""Nearest points of capsules: against brute force, and where they are not unique."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from nearest_measured import PACK, Measured
from physics_helpers import nearest, report

from newton_qd import physics
from newton_qd.physics.system import System
from newton_qd.robots import ANT
from newton_qd.scenes import TRAP


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(tmp_path_factory.mktemp("walls"))


def trap_of_the_ant() -> tuple[System, int, int]:
    """System, and the contacts of torso and a foot with the back wall."""
    system = physics.load_system(ANT, "float64", TRAP)
    back = np.flatnonzero(system.contact_obstacle == 1)
    return system, int(back[0]), int(back[1])


@pytest.mark.slow
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
    reach = radius + system.contact_radius[foot]
    touching = exact < reach
    found = Measured(folder, system, foot, at, along)
    excess = (found.distance + radius - exact)[near]
    smoothing = system.robot.material.smoothing
    report(
        "excess of the distance, mean and largest [m]", (excess.mean(), excess.max())
    )
    assert near.sum() > 300
    assert excess.min() > -1e-6  # grid of the brute force, SHORTEST
    assert excess.max() < 0.3 * smoothing
    deep = (found.distance + radius - exact)[touching]
    report("the same where the axes nearly cross [m]", deep.max())
    assert 0.3 * smoothing < deep.max() < 1.4 * smoothing
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
