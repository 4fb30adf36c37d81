"""Motion without contact: what the scheme conserves, and its order of convergence.

Semi-implicit Euler in generalized coordinates conserves the momentum of a body whose
velocity coordinates are its momentum; an articulated robot's momentum drifts with
the first power of the substep h. What has nothing to touch with keeps its energy.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics_helpers import (
    momentum,
    order,
    passive,
    random_states,
    report,
    rollout,
    variant,
)
from urdf_text import joint, row, write

from newton_qd.physics import reference
from newton_qd.physics.model import build_system
from newton_qd.physics.system import System
from newton_qd.robots import ACROBOT, ANT

pytestmark = pytest.mark.usefixtures("x64")

GRAVITY = 9.8  # [m/s^2]
HIGH = 10.0  # where nothing is touched [m]
SECONDS = 1.0
SUBSTEPS = np.array([10, 20, 40, 80])  # of an ant's control step of 0.05 s


def free_body(folder: Path, moments: tuple[float, ...], **changes: Any) -> System:
    """A body without colliders; its centre of mass is its origin."""
    ixx, iyy, izz = moments
    text = f"""<robot name="body"><link name="body"><inertial><mass value="2.5"/>
      <inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"/>
      </inertial></link></robot>"""
    return build_system(row(write(folder, text), "body", **changes), "float64")


def launched(system: System) -> tuple[jax.Array, jax.Array]:
    """A first state that moves and turns about no axis of symmetry."""
    q = jnp.asarray(system.rest_q).at[:3].set(jnp.array([0.3, -0.2, 50.0]))
    return q, jnp.array([1.0, -2.0, 3.0, 0.7, -1.5, 2.0])


def relative_drift(system: System, q: jax.Array, v: jax.Array) -> tuple[float, float]:
    """Change of linear and of angular momentum per second, without controls."""
    steps = round(SECONDS / system.robot.dt)
    end = rollout(system)(q, v, passive(system, steps))
    drift = []
    first, last = momentum(system)(q, v), momentum(system)(end.q[-1], end.v[-1])
    for before, after in zip(first, last, strict=True):
        change = jnp.linalg.norm(after - before) / jnp.linalg.norm(before)
        drift.append(float(change) / SECONDS)
    return drift[0], drift[1]


def test_rigid_body_conserves_momentum(tmp_path: Path) -> None:
    system = free_body(tmp_path, (0.2, 0.2, 0.2), gravity=0.0)
    linear, angular = relative_drift(system, *launched(system))
    report("relative drift, linear, angular [1/s]", (linear, angular))
    assert linear < 1e-12
    assert angular < 1e-12


def test_uneven_body_conserves_linear_momentum(tmp_path: Path) -> None:
    """Angular momentum drifts with order 1: its inertia turns within a substep."""
    angular = []
    for count in SUBSTEPS:
        system = free_body(
            tmp_path, (0.1, 0.2, 0.25), gravity=0.0, dt=0.1, substeps=int(count)
        )
        linear, drift = relative_drift(system, *launched(system))
        assert linear < 1e-12
        angular.append(drift)
    slope = order(1 / SUBSTEPS, np.array(angular))
    report("order of angular momentum", slope)
    assert slope == pytest.approx(1.0, abs=0.1)


def test_translating_robot_conserves_momentum() -> None:
    """An articulated robot that only translates is a free particle."""
    system = variant(ANT, "float64", gravity=0.0)
    v = jnp.zeros(system.nv).at[:3].set(jnp.array([3.0, -1.0, 2.0]))
    q = jnp.asarray(system.rest_q).at[2].add(HIGH)
    end = rollout(system)(q, v, passive(system, 20))
    np.testing.assert_allclose(end.v[-1], v, atol=1e-12)


def test_momentum_of_robot_drifts_with_order_one() -> None:
    """Torques, damping and limits of the joints are internal: only h moves it."""
    rng = np.random.default_rng(0)
    q, v, _ = random_states(variant(ANT, "float64"), rng, 4)
    q[:, 2] += HIGH
    controls = jnp.asarray(rng.uniform(-0.1, 0.1, (8, 8)))
    drift = np.zeros((len(SUBSTEPS), 2))
    for i, count in enumerate(SUBSTEPS):
        system = variant(ANT, "float64", gravity=0.0, substeps=int(count))
        for start_q, start_v in zip(q, v, strict=True):
            end = rollout(system)(start_q, start_v, controls)
            first = momentum(system)(start_q, start_v)
            last = momentum(system)(end.q[-1], end.v[-1])
            for k in range(2):
                drift[i, k] += float(jnp.linalg.norm(last[k] - first[k]))
    slopes = [order(1 / SUBSTEPS, drift[:, k]) for k in range(2)]
    report("order of linear, angular momentum", slopes)
    assert slopes == pytest.approx([1.0, 1.0], abs=0.1)


def test_parabola(tmp_path: Path) -> None:
    """The scheme's own closed form: g t (t + h) / 2 instead of g t^2 / 2."""
    system = free_body(tmp_path, (0.1, 0.2, 0.25), gravity=GRAVITY)
    h = system.h
    q, v = launched(system)
    path = rollout(system)(q, v, passive(system, 50))
    t = system.robot.dt * np.arange(1, 51)[:, None]
    down = np.array([0.0, 0.0, -GRAVITY])
    expected = q[:3] + v[:3] * t + 0.5 * down * t * (t + h)
    np.testing.assert_allclose(path.q[:, :3], expected, rtol=1e-12)
    np.testing.assert_allclose(path.v[:, :3], v[:3] + down * t, rtol=1e-12)


ARM, BOB, TURNING = 0.7, 1.3, 0.02  # [m], [kg], [kg m^2]


def pendulum(folder: Path, substeps: int) -> System:
    """A bob on a fixed hinge, hanging at angle 0."""
    hinge = joint("hinge", "continuous", "world", "bob", '<axis xyz="0 1 0"/>')
    text = f"""<robot name="pendulum"><link name="world"/><link name="bob"><inertial>
      <origin xyz="0 0 {-ARM}"/><mass value="{BOB}"/>
      <inertia ixx="{TURNING}" iyy="{TURNING}" izz="{TURNING}" ixy="0" ixz="0"
      iyz="0"/></inertial></link>{hinge}</robot>"""
    robot = row(write(folder, text), "bob", dt=0.02, substeps=substeps, gravity=GRAVITY)
    return build_system(robot, "float64")


def period(angle: float) -> float:
    """Period of a physical pendulum of some amplitude [s]."""
    slow = np.sqrt((TURNING + BOB * ARM**2) / (BOB * GRAVITY * ARM))
    a, b = 1.0, np.cos(angle / 2)
    for _ in range(10):  # arithmetic-geometric mean
        a, b = (a + b) / 2, np.sqrt(a * b)
    return float(2 * np.pi * slow / a)


def test_pendulum_period(tmp_path: Path) -> None:
    """Order 2: for one hinge the scheme is leapfrog with a shifted start."""
    amplitude, dt = 1.2, 0.02
    steps = round(3 * period(amplitude) / dt)
    counts = np.array([1, 2, 4])
    errors = []
    for count in counts:
        system = pendulum(tmp_path, int(count))
        path = rollout(system)(
            jnp.array([amplitude]), jnp.zeros(1), passive(system, steps)
        )
        q, v = np.asarray(path.q[:, 0]), np.asarray(path.v[:, 0])
        # where it passes the lowest point, free of force: q is a straight line there
        down = np.flatnonzero((q[:-1] > 0) & (q[1:] <= 0))
        times = dt * (down + q[down] / (q[down] - q[down + 1]))
        assert len(times) == 3
        errors.append(abs((times[2] - times[0]) / 2 - period(amplitude)))
        energy = 0.5 * (TURNING + BOB * ARM**2) * v**2
        energy += BOB * GRAVITY * ARM * (1 - np.cos(q))
        first = BOB * GRAVITY * ARM * (1 - np.cos(amplitude))
        assert np.abs(energy / first - 1).max() < 0.1 / count
    assert errors[0] < 1e-3 * period(amplitude)
    slope = order(1 / counts, np.array(errors))
    report("order of the period", slope)
    assert slope == pytest.approx(2.0, abs=0.2)


def test_pendulum_angle_converges_with_order_one(tmp_path: Path) -> None:
    """A quarter period after the start it passes the lowest point."""
    amplitude, steps = 1.2, 25
    counts = np.array([2, 4, 8, 16])
    ends = []
    for count in [*counts, 1024]:
        system = pendulum(tmp_path, int(count))
        path = rollout(system)(
            jnp.array([amplitude]), jnp.zeros(1), passive(system, steps)
        )
        ends.append(float(path.q[-1, 0]))
    errors = np.abs(np.array(ends[:-1]) - ends[-1])
    slope = order(1 / counts, errors)
    report("order of the angle", slope)
    assert slope == pytest.approx(1.0, abs=0.1)


def energy(system: System, q: np.ndarray, v: np.ndarray) -> tuple[float, float]:
    """Kinetic and potential energy [J]."""
    frames = reference.body_frames(system, q)
    heights = [
        reference.compose(frame, np.append(com, [0, 0, 0, 1.0]))[2]
        for frame, com in zip(frames, system.com, strict=True)
    ]
    weights = system.mass * system.robot.gravity
    kinetic = 0.5 * v @ reference.mass_matrix(system, q) @ v
    return float(kinetic), float(weights @ heights)


@pytest.mark.parametrize("speed", [5.0, 15.0, 30.0])
def test_double_pendulum_keeps_its_energy(speed: float) -> None:
    """With velocity products of the start of a substep it would take off."""
    system, worlds, seconds = variant(ACROBOT, "float64"), 8, 20
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (worlds, 2))
    v = np.tile([speed, -speed], (worlds, 1))
    each = round(1 / system.robot.dt)
    path = jax.vmap(rollout(system))(q, v, np.zeros((worlds, seconds * each, 1)))
    drift = []
    for world in range(worlds):
        kinetic, potential = energy(system, q[world], v[world])
        for n in range(each - 1, seconds * each, each):
            now = energy(system, *(np.asarray(x[world, n]) for x in (path.q, path.v)))
            drift.append(abs(sum(now) - kinetic - potential) / kinetic)
    report("largest change of energy, of the kinetic at the start", max(drift))
    assert max(drift) < 0.05
