"""Contact against closed forms: rest, creep, sliding, and what can never happen."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics_helpers import (
    BOX_HEIGHT,
    BOX_MASS,
    box_system,
    passive,
    penetration,
    random_states,
    report,
    resting_gap,
    rollout,
    variant,
)

from newton_qd import physics
from newton_qd.physics import reference
from newton_qd.physics.system import ObstacleKind, PhysicsState, System
from newton_qd.robots import ANT

GRAVITY = 9.81  # [m/s^2]


def foot_heights(system: System, q: np.ndarray) -> np.ndarray:
    """Heights (feet,) of the feet's lowest points over the ground [m]."""
    frames = reference.body_frames(system, q)
    heights = []
    for foot in system.feet:
        (contact,) = np.flatnonzero(system.contact_body == foot)
        rotation = reference.rotation_matrix(frames[foot, 3:])
        centre = frames[foot, :3] + rotation @ system.contact_position[contact]
        heights.append(centre[2] - system.contact_radius[contact])
    return np.array(heights)


def test_standing_ant() -> None:
    """Zero action from the default pose, in the sixth second."""
    system = physics.load_system(ANT)
    steps = round(1.0 / ANT.dt)
    path = rollout(system)(
        jnp.asarray(system.rest_q, np.float32),
        jnp.zeros(system.nv, np.float32),
        passive(system, 6 * steps),
    )
    q = np.asarray(path.q, np.float64)[-steps - 1 :]
    heights = np.mean([foot_heights(system, row) for row in q[1:]], axis=0)
    creep = np.linalg.norm(q[-1, :3] - q[0, :3])
    report("height of the feet [mm]", 1e3 * heights)
    report("creep of the torso [mm/s]", 1e3 * creep)
    assert np.abs(heights).max() < 5e-3
    assert creep < 1e-3
    # four feet carry the weight: each by the penetration that the robot's row states
    material = ANT.material
    deep = penetration(heights, material.smoothing)
    np.testing.assert_allclose(deep, material.static_penetration, rtol=1e-2)


@pytest.mark.parametrize("smoothing", [0.02, 0.001])
def test_penetration_at_rest(x64: None, tmp_path: Path, smoothing: float) -> None:
    system = box_system(tmp_path, 0.0, smoothing=smoothing)
    q = jnp.asarray(system.rest_q).at[2].set(BOX_HEIGHT)
    path = rollout(system)(q, jnp.zeros(6), passive(system, 300))
    gap = float(path.q[-1, 2]) - BOX_HEIGHT
    stated = system.robot.material.static_penetration
    assert float(penetration(gap, smoothing)) == pytest.approx(stated, rel=1e-6)
    if smoothing < stated:
        assert gap == pytest.approx(-stated, rel=1e-6)
    assert gap == pytest.approx(resting_gap(system, GRAVITY), abs=1e-8)


def test_sphere_rests_on_capsule(x64: None, tmp_path: Path) -> None:
    """An obstacle with a curved surface carries the same weight."""
    system = box_system(tmp_path, 0.0)
    lying = reference.axis_quaternion(np.array([0.0, 1.0, 0.0]), np.pi / 2)
    system = dataclasses.replace(
        system,
        contact_body=np.zeros(1, np.int32),
        contact_obstacle=np.zeros(1, np.int32),
        contact_position=np.zeros((1, 3)),
        contact_segment=np.zeros((1, 3)),
        contact_radius=np.array([0.1]),
        obstacle_kind=np.array([ObstacleKind.CAPSULE], np.int32),
        obstacle_frame=np.concatenate([[0.2, 0.0, 0.3], lying])[None],
        obstacle_size=np.array([[0.15, 0.5, 0.0]]),
    )
    q = jnp.asarray(system.rest_q).at[:3].set(jnp.array([0.5, 0.0, 0.55]))
    path = rollout(system)(q, jnp.zeros(6), passive(system, 300))
    # one contact instead of four
    stated = 4 * system.robot.material.static_penetration
    gap = float(path.q[-1, 2]) - 0.55
    smoothing = system.robot.material.smoothing
    assert float(penetration(gap, smoothing)) == pytest.approx(stated, rel=1e-6)
    np.testing.assert_allclose(path.q[-1, :2], [0.5, 0.0], atol=1e-9)


def on_slope(
    folder: Path, friction: float, ratio: float, steps: int
) -> tuple[PhysicsState, np.ndarray, System, float]:
    """A box let go in normal balance on a plane of slope atan(friction ratio).

    Returns:
        States (steps, ...), velocities (steps, 3) in the axes of the plane, the
        system, and the slope [rad].
    """
    angle = float(np.arctan(friction * ratio))
    system = box_system(folder, angle, friction=friction)
    tilt = system.obstacle_frame[0, 3:]
    turn = reference.rotation_matrix(tilt)
    height = BOX_HEIGHT + resting_gap(system, GRAVITY * np.cos(angle))
    q = np.concatenate([turn @ np.array([0.0, 0.0, height]), tilt])
    path = rollout(system)(q, jnp.zeros(6), passive(system, steps))
    return path, np.asarray(path.v[:, :3]) @ turn, system, angle


@pytest.mark.parametrize("friction", [0.5, 1.0])
@pytest.mark.parametrize("ratio", [0.25, 0.5, 0.9])
def test_creep(x64: None, tmp_path: Path, friction: float, ratio: float) -> None:
    """Below the cone a box creeps at the speed that the regularization states."""
    path, v, system, angle = on_slope(tmp_path, friction, ratio, 300)
    slow = system.robot.material.slip_velocity
    expected = slow * ratio / np.sqrt(1 - ratio**2)
    report("creep, relative error", abs(v[-1, 0] / expected - 1))
    assert v[-1, 0] == pytest.approx(expected, rel=0.02)
    np.testing.assert_allclose(v[-1, 1:], 0.0, atol=1e-6)
    normal = float(path.normal_impulse[-1, 0]) / system.robot.dt
    assert normal == pytest.approx(BOX_MASS * GRAVITY * np.cos(angle), rel=1e-4)


@pytest.mark.parametrize("ratio", [1.5, 2.0, 3.0])
def test_slide(x64: None, tmp_path: Path, ratio: float) -> None:
    """Beyond the cone it accelerates as Coulomb says, in every step."""
    _, v, system, angle = on_slope(tmp_path, 0.5, ratio, 200)
    fast = v[:-1, 0] > 20 * system.robot.material.slip_velocity
    assert fast.sum() > 50
    acceleration = np.diff(v[:, 0])[fast] / system.robot.dt
    expected = GRAVITY * (np.sin(angle) - 0.5 * np.cos(angle))
    report("acceleration, relative error", np.abs(acceleration / expected - 1).max())
    np.testing.assert_allclose(acceleration, expected, rtol=0.02)


@pytest.mark.parametrize("ratio", [1.5, 2.0, 3.0])
def test_slide_on_steep_slope(x64: None, tmp_path: Path, ratio: float) -> None:
    """Friction 1: the box still rocks when it gets fast, so its load is not even.

    Friction is at the cone of the load of each step, and the acceleration is
    Coulomb's in the mean.
    """
    path, v, system, angle = on_slope(tmp_path, 1.0, ratio, 200)
    fast = v[:-1, 0] > 20 * system.robot.material.slip_velocity
    assert fast.sum() > 50
    acceleration = np.diff(v[:, 0])[fast] / system.robot.dt
    expected = GRAVITY * (np.sin(angle) - np.cos(angle))
    report("acceleration, largest error", np.abs(acceleration / expected - 1).max())
    assert acceleration.mean() == pytest.approx(expected, rel=0.02)
    tilt = reference.rotation_matrix(system.obstacle_frame[0, 3:])
    impulse = np.asarray(path.impulse[1:, 0, :3])[fast] @ tilt
    load = np.asarray(path.normal_impulse[1:, 0])[fast]
    np.testing.assert_allclose(-impulse[:, 0] / load, 1.0, rtol=0.02)


def test_impulse_is_the_change_of_momentum(x64: None, tmp_path: Path) -> None:
    system = box_system(tmp_path, 0.3)
    rng = np.random.default_rng(0)
    q = np.concatenate([[0.0, 0.0, BOX_HEIGHT - 0.01], system.obstacle_frame[0, 3:]])
    v = jnp.asarray(rng.normal(size=6))
    path = rollout(system)(q, v, passive(system, 1))
    change = np.asarray(path.v[0] - v)
    weight = np.array([0.0, 0.0, -BOX_MASS * GRAVITY * system.robot.dt])
    linear, angular = np.split(np.asarray(path.impulse[0, 0]), 2)
    assert float(path.normal_impulse[0, 0]) > 0.1
    np.testing.assert_allclose(linear, BOX_MASS * change[:3] - weight, atol=1e-12)
    np.testing.assert_allclose(angular, system.inertia[0] @ change[3:], atol=1e-12)


WORLDS, SUBSTEPS = 256, 300


@pytest.fixture(scope="module")
def struggle(device: jax.Device) -> tuple[System, np.ndarray, np.ndarray]:
    """Ants under maximal random torque, new in each substep or in each fifth.

    Returns:
        System, linear impulses (worlds, substeps, nb, 3) and normal impulses
        (worlds, substeps, nb), each of one substep of 10 ms [N s].
    """
    del device  # chosen before the arrays are made
    system = variant(ANT, "float32", dt=variant(ANT, "float32").h, substeps=1)
    rng = np.random.default_rng(0)
    q, v, _ = (x.astype(np.float32) for x in random_states(system, rng, WORLDS))
    controls = rng.choice([-1.0, 1.0], (WORLDS, SUBSTEPS, system.nu))
    half = WORLDS // 2
    controls[half:] = np.repeat(controls[half:, ::5], 5, axis=1)
    path = jax.vmap(rollout(system))(q, v, controls.astype(np.float32))
    impulse = np.asarray(path.impulse, np.float64)[..., :3]
    return system, impulse, np.asarray(path.normal_impulse, np.float64)


def test_normal_impulse_is_never_negative(
    struggle: tuple[System, np.ndarray, np.ndarray],
) -> None:
    system, impulse, normal = struggle
    feet = normal[:, :, system.feet]
    assert np.isfinite(impulse).all()
    assert (feet > 0).mean() > 0.2
    assert normal.min() >= 0.0
    # the ground is level: its normal impulse is the vertical one
    np.testing.assert_array_equal(impulse[..., 2], normal)


def test_friction_cone(struggle: tuple[System, np.ndarray, np.ndarray]) -> None:
    system, impulse, normal = struggle
    touching = np.unique(system.contact_body)
    load = normal[:, :, touching]
    sheared = np.linalg.norm(impulse[:, :, touching, :2], axis=-1)
    weight = system.total_mass * ANT.gravity * system.robot.dt
    # below a millionth of the weight, float32 leaves nothing of the ratio
    counts = load > 1e-6 * weight
    ratio = sheared[counts] / (ANT.material.friction * load[counts])
    shares = [50, 90, 99, 99.9, 100]
    report("|J_t| / (mu J_n), contacts", len(ratio))
    report(f"percentiles {shares}", np.percentile(ratio, shares))
    report("share above 1.5", (ratio > 1.5).mean())
    assert ratio.max() < 1.5
