"""The solver in a plain Newton loop: the same physics, in Newton's conventions."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from newton_loops import (
    ARM,
    PLANAR,
    Loop,
    assign,
    moving_ants,
    numpy,
    off_centre,
    standing_ants,
)
from urdf_text import row, write

from newton_qd import physics
from newton_qd.physics.reference import rotation_matrix
from newton_qd.robots import ANT

pytestmark = pytest.mark.usefixtures("newton_without_adjoints")


@pytest.mark.slow
@pytest.mark.parametrize("worlds", [1, 3])
def test_same_trajectory_as_the_step(worlds: int, device: jax.Device) -> None:
    q, actions = standing_ants(worlds, 12)
    system = physics.load_system(ANT)
    loop = Loop(ANT, worlds, device)
    forces = np.zeros((worlds, system.nv), np.float32)
    loop.set(q, forces, forces)
    state = jax.vmap(lambda q: physics.initial_state(system, q, jnp.zeros(14)))(
        jnp.asarray(q, jnp.float32)
    )
    advance = jax.jit(jax.vmap(lambda s, a: physics.step(system, s, a)[0]))
    touched = 0.0
    for action in actions:
        state = advance(state, action)
        forces[:, system.control_dof] = np.float32(system.gear) * action
        assign(loop.control.joint_f, forces)
        impulse = np.zeros((worlds, system.nb))
        for _ in range(system.substeps):
            loop.step(system.h)
            impulse += loop.solver.normal_impulse.numpy()
        np.testing.assert_allclose(loop.q, state.q, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(loop.qd, state.v, rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(impulse, state.normal_impulse, rtol=1e-4, atol=1e-4)
        touched += float(impulse.sum())
    assert touched > 0.0
    assert not loop.solver.fault.numpy().any()


@pytest.mark.slow
def test_bodies_are_written(device: jax.Device) -> None:
    loop = moving_ants(device)
    loop.step(0.01)
    system = physics.load_system(ANT)
    for world in range(2):
        # the centre of mass of the ant's torso is its origin
        q, v = jnp.asarray(loop.q[world]), jnp.asarray(loop.qd[world])
        expected = physics.forward_kinematics(system, q, v)
        poses = numpy(loop.now.body_q, 2)[world].reshape(9, 7)
        twists = numpy(loop.now.body_qd, 2)[world].reshape(9, 6)
        np.testing.assert_allclose(poses[:, :3], expected.position, atol=1e-5)
        np.testing.assert_allclose(twists[:, :3], expected.linear_velocity, atol=1e-4)
        np.testing.assert_allclose(twists[:, 3:], expected.angular_velocity, atol=1e-4)


@pytest.mark.slow
def test_in_place_and_default_control(device: jax.Device) -> None:
    """``state_out`` may be ``state_in``; no control means the model's forces."""
    loop = moving_ants(device)
    alone = loop.model.state()
    assign(alone.joint_q, loop.q)
    assign(alone.joint_qd, loop.qd)
    assign(loop.model.joint_f, np.full((2, 14), 2.0))
    loop.step(0.01, times=3)
    for _ in range(3):
        loop.solver.step(alone, alone, None, None, 0.01)
    np.testing.assert_array_equal(numpy(alone.joint_q, 2), loop.q)
    np.testing.assert_array_equal(numpy(alone.joint_qd, 2), loop.qd)


@pytest.mark.slow  # compiles kernels of Newton
def test_wrench_changes_the_momentum(tmp_path: Path, device: jax.Device) -> None:
    """Only the free joint's wrench does, and it acts at the centre of mass."""
    loop = Loop(off_centre(tmp_path, ARM, gravity=0.0), 1, device)
    rng = np.random.default_rng(2)
    step = 1e-3
    for _ in range(10):
        q = rng.normal(size=8)
        q[3:7] /= np.linalg.norm(q[3:7])
        force = rng.normal(size=7) * 100.0
        loop.set(q, rng.normal(size=7), force)
        before = loop.momentum()
        loop.step(step)
        rate = (loop.momentum() - before) / step
        at = q[:3] + rotation_matrix(q[3:7]) @ loop.model.body_com.numpy()[0]
        expected = np.concatenate([force[:3], force[3:6] + np.cross(at, force[:3])])
        np.testing.assert_allclose(rate, expected, atol=0.02 * np.abs(expected).max())


@pytest.mark.slow  # compiles kernels of Newton
def test_free_flight_about_an_off_centre_mass(
    tmp_path: Path, device: jax.Device
) -> None:
    """The centre of mass falls on a parabola and the spin is kept, to first order."""
    gravity, duration = 9.81, 0.4
    robot = off_centre(tmp_path, gravity=gravity)
    loop = Loop(robot, 1, device)
    velocity, omega = np.array([1.0, -0.5, 2.0]), np.array([0.8, -1.2, 0.6])
    com = loop.model.body_com.numpy()[0]
    errors = []
    for steps in (200, 400):
        q = np.array([0.1, 0.2, 5.0, 0.1, -0.2, 0.3, 0.9])
        q[3:] /= np.linalg.norm(q[3:])
        loop.set(q, np.concatenate([velocity, omega]), np.zeros(6))
        start, spin = _com_and_spin(loop, com)
        loop.step(duration / steps, times=steps)
        end, spin_after = _com_and_spin(loop, com)
        fall = np.array([0.0, 0.0, -gravity])
        path = start + velocity * duration + fall * duration**2 / 2
        np.testing.assert_allclose(
            loop.qd[0, :3], velocity + fall * duration, atol=0.02
        )
        errors.append([np.abs(end - path).max(), np.abs(spin_after - spin).max()])
    assert max(errors[0]) < 0.02  # and half the error with half the step:
    np.testing.assert_allclose(errors[1], np.array(errors[0]) / 2, rtol=0.2)


def _com_and_spin(loop: Loop, com: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass [m] and angular momentum about it [N m s] of a single body."""
    q, momentum = loop.q[0], loop.momentum()
    at = q[:3] + rotation_matrix(q[3:7]) @ com
    return at, momentum[3:] - np.cross(at, momentum[:3])


def test_root_on_a_rail(tmp_path: Path, device: jax.Device) -> None:
    """Without a free joint nothing is converted."""
    robot = row(write(tmp_path, PLANAR), "cart", gravity=0.0)
    loop = Loop(robot, 2, device)
    loop.set(np.array([0.5, -0.5]), np.array([1.0, 2.0]), np.array([4.0, -4.0]))
    loop.step(0.1)
    np.testing.assert_allclose(loop.qd.ravel(), [1.2, 1.8], rtol=1e-6)
    np.testing.assert_allclose(loop.q.ravel(), [0.62, -0.32], rtol=1e-5)


def test_faulty_world_stays(device: jax.Device) -> None:
    q, _ = standing_ants(3, 0)
    loop = Loop(ANT, 3, device)
    forces = np.zeros((3, 14))
    forces[1, 9] = np.nan
    loop.set(q, np.zeros((3, 14)), forces)
    loop.step(0.01)
    np.testing.assert_array_equal(loop.solver.fault.numpy(), [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(loop.q[1], np.float32(q[1]))
    assert np.abs(loop.qd[[0, 2]]).max() > 0.0 and not loop.qd[1].any()


def test_changing_step_length(tmp_path: Path, device: jax.Device) -> None:
    """Any length works, and old lengths do not pile up."""
    loop = Loop(off_centre(tmp_path, gravity=0.0), 1, device)
    loop.set(
        np.array([0, 0, 1, 0, 0, 0, 1.0]), np.array([1, 0, 0, 0, 0, 0.0]), np.zeros(6)
    )
    lengths = np.linspace(0.01, 0.02, 12)
    for dt in lengths:
        loop.step(float(dt))
    np.testing.assert_allclose(loop.q[0, 0], lengths.sum(), rtol=1e-5)
    assert loop.solver._launcher.cache_info().currsize < len(lengths)
