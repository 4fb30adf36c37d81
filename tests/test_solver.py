"""The solver in a plain Newton loop: the same physics, in Newton's conventions."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import newton
import numpy as np
import pytest
import warp as wp
from urdf_text import row, sphere, write

from newton_qd import physics
from newton_qd.assets import find_urdf
from newton_qd.physics.model import newton_builder
from newton_qd.physics.model.description import read_description
from newton_qd.physics.reference import rotation_matrix
from newton_qd.physics.solver import NewtonQDSolver
from newton_qd.robots import ANT, RobotSpec

pytestmark = pytest.mark.usefixtures("newton_without_adjoints")

# One link whose centre of mass is far from its origin, and a link that swings.
OFF_CENTRE = """<robot name="off_centre">
  <link name="base"><inertial><origin xyz="0.2 -0.3 0.1"/><mass value="2.0"/>
    <inertia ixx="0.2" iyy="0.3" izz="0.4" ixy="0.02" ixz="-0.03" iyz="0.01"/>
  </inertial>{collider}</link>{arm}
</robot>"""
ARM = """
  <link name="arm"><inertial><origin xyz="0.3 0.1 -0.2"/><mass value="1.5"/>
    <inertia ixx="0.1" iyy="0.15" izz="0.12" ixy="0.01" ixz="0.0" iyz="-0.02"/>
  </inertial></link>
  <joint name="elbow" type="continuous"><parent link="base"/><child link="arm"/>
    <origin xyz="0.1 0.4 -0.2" rpy="0.3 0.2 -0.5"/><axis xyz="0.6 0 0.8"/></joint>"""
PLANAR = """<robot name="cart"><link name="world"/>
  <link name="cart"><inertial><origin xyz="0.1 0 0.2"/><mass value="2"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="rail" type="prismatic"><parent link="world"/><child link="cart"/>
    <axis xyz="1 0 0"/><limit lower="-9" upper="9" effort="1" velocity="1"/></joint>
</robot>"""


def off_centre(
    folder: Path, arm: str = "", collider: str = "", **changes: Any
) -> RobotSpec:
    path = write(folder, OFF_CENTRE.format(arm=arm, collider=collider))
    return row(path, "base", **changes)


def replicated(robot: RobotSpec, worlds: int) -> newton.ModelBuilder:
    scene = newton.ModelBuilder()
    scene.replicate(one_world(robot), worlds)
    return scene


def one_world(robot: RobotSpec) -> newton.ModelBuilder:
    path = find_urdf(robot.urdf)
    return newton_builder(str(path), read_description(path).floating, robot.gravity)


def finalized(builder: newton.ModelBuilder, device: jax.Device) -> newton.Model:
    return builder.finalize(device="cpu" if device.platform == "cpu" else "cuda:0")


def assign(array: wp.array | None, values: np.ndarray) -> None:
    assert array is not None
    array.assign(np.asarray(values, np.float32).ravel())


def forward_kinematics(model: newton.Model, state: newton.State) -> None:
    assert state.joint_q is not None and state.joint_qd is not None
    newton.eval_fk(model, state.joint_q, state.joint_qd, state)


def numpy(array: wp.array | None, worlds: int) -> np.ndarray:
    assert array is not None
    return array.numpy().astype(np.float64).reshape(worlds, -1)


class Loop:
    """A Newton loop over some worlds, read and set as NumPy arrays."""

    def __init__(self, robot: RobotSpec, worlds: int, device: jax.Device) -> None:
        self.worlds = worlds
        self.model = finalized(replicated(robot, worlds), device)
        self.solver = NewtonQDSolver(self.model, robot)
        self.now, self.next = self.model.state(), self.model.state()
        self.control = self.model.control()

    def set(self, q: np.ndarray, qd: np.ndarray, joint_f: np.ndarray) -> None:
        assign(self.now.joint_q, q)
        assign(self.now.joint_qd, qd)
        assign(self.control.joint_f, joint_f)
        forward_kinematics(self.model, self.now)

    def step(self, dt: float, times: int = 1) -> None:
        for _ in range(times):
            self.solver.step(self.now, self.next, self.control, None, dt)
            self.now, self.next = self.next, self.now

    @property
    def q(self) -> np.ndarray:
        return numpy(self.now.joint_q, self.worlds)

    @property
    def qd(self) -> np.ndarray:
        return numpy(self.now.joint_qd, self.worlds)

    def momentum(self) -> np.ndarray:
        """Linear momentum, and angular about the world's origin, (6,) of world 0."""
        total = np.zeros(6)
        coms, masses = self.model.body_com.numpy(), self.model.body_mass.numpy()
        poses = numpy(self.now.body_q, self.model.body_count)
        twists = numpy(self.now.body_qd, self.model.body_count)
        inertias = self.model.body_inertia.numpy()
        for body in range(self.model.body_count // self.worlds):
            turn = rotation_matrix(poses[body, 3:])
            linear = masses[body] * twists[body, :3]
            at = poses[body, :3] + turn @ coms[body]
            spin = turn @ inertias[body] @ turn.T @ twists[body, 3:]
            total += np.concatenate([linear, spin + np.cross(at, linear)])
        return total


def standing_ants(worlds: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Start (worlds, nq) on the ground, and actions (steps, worlds, nu)."""
    rng = np.random.default_rng(1)
    q = np.tile(physics.load_system(ANT).rest_q, (worlds, 1))
    q[:, 7:] += rng.uniform(-0.1, 0.1, (worlds, 8))
    return q, rng.uniform(-1.0, 1.0, (steps, worlds, 8)).astype(np.float32)


def moving_ants(device: jax.Device) -> Loop:
    loop = Loop(ANT, 2, device)
    q, _ = standing_ants(2, 0)
    loop.set(q, np.full((2, 14), 0.3), np.full((2, 14), 2.0))
    return loop


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


def test_models_that_are_accepted(tmp_path: Path, device: jax.Device) -> None:
    robot = off_centre(tmp_path, ARM, sphere(0.1))
    one = NewtonQDSolver(finalized(one_world(robot), device), robot)
    assert one.fault.shape == (1,)
    scene = newton.ModelBuilder()
    scene.add_ground_plane()
    scene.add_world(one_world(robot))
    scene.add_world(one_world(robot))
    two = NewtonQDSolver(finalized(scene, device), robot)
    assert two.fault.shape == (2,)


def _edited(name: str, index: Any, value: float) -> Callable[[newton.Model], None]:
    def edit(model: newton.Model) -> None:
        array = getattr(model, name)
        values = array.numpy()
        values[index] = value
        array.assign(values)

    return edit


@pytest.mark.parametrize(
    ("name", "world", "edit"),
    [
        ("body_mass", 1, _edited("body_mass", 2, 2.5)),
        ("body_com", 2, _edited("body_com", (5, 0), 0.5)),
        ("body_inertia", 0, _edited("body_inertia", (0, 1, 1), 9.0)),
        ("joint_X_p", 1, _edited("joint_X_p", (3, 2), 0.5)),
        ("joint_parent", 2, _edited("joint_parent", 5, 0)),
        ("joint_axis", 1, _edited("joint_axis", (13, 0), -0.5)),
        ("joint_armature", 0, _edited("joint_armature", slice(None), 0.01)),
        ("joint_target_ke", 2, _edited("joint_target_ke", 20, 10.0)),
        ("gravity", 1, _edited("gravity", (1, 2), -1.6)),
        ("shape_scale", 1, _edited("shape_scale", (1, 0), 0.3)),
    ],
)
def test_worlds_must_be_identical(
    tmp_path: Path,
    device: jax.Device,
    name: str,
    world: int,
    edit: Callable[[newton.Model], None],
) -> None:
    robot = off_centre(tmp_path, ARM, sphere(0.1))
    model = finalized(replicated(robot, 3), device)
    solver = NewtonQDSolver(model, robot)
    edit(model)
    with pytest.raises(ValueError, match=rf"model\.{name} of world {world}: got"):
        NewtonQDSolver(model, robot)
    with pytest.raises(ValueError, match=rf"model\.{name}"):
        solver.notify_model_changed(0)


def _particle(scene: newton.ModelBuilder, robot: RobotSpec) -> None:
    scene.add_particle((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), mass=1.0)


def _other_robot(scene: newton.ModelBuilder, robot: RobotSpec) -> None:
    scene.add_world(one_world(ANT))


def _two_in_a_world(scene: newton.ModelBuilder, robot: RobotSpec) -> None:
    scene.begin_world()
    for _ in range(2):
        scene.add_builder(one_world(robot))
    scene.end_world()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_particle, "model.particle_count: got 1; allowed: 0"),
        (_other_robot, "model.body_count: got 13; allowed: 6: 3 worlds, each with one"),
        (_two_in_a_world, "model.body_count: got 8; allowed: 6"),
    ],
)
def test_other_things_in_the_model(
    tmp_path: Path, device: jax.Device, change: Callable, message: str
) -> None:
    robot = off_centre(tmp_path, ARM)
    scene = replicated(robot, 2)
    change(scene, robot)
    with pytest.raises(ValueError, match=message):
        NewtonQDSolver(finalized(scene, device), robot)


def test_another_joint_and_nothing(tmp_path: Path, device: jax.Device) -> None:
    robot = off_centre(tmp_path, ARM)
    builder = one_world(robot)
    builder.joint_type[1] = newton.JointType.PRISMATIC
    with pytest.raises(ValueError, match=r"model\.joint_type of world 0: got 0; allow"):
        NewtonQDSolver(finalized(builder, device), robot)
    with pytest.raises(ValueError, match=r"model\.body_count: got 0; allowed: 2"):
        NewtonQDSolver(finalized(newton.ModelBuilder(), device), robot)


def test_bad_arguments_of_a_step(tmp_path: Path, device: jax.Device) -> None:
    robot = off_centre(tmp_path, ARM)
    loop = Loop(robot, 2, device)
    for dt in (0.0, -0.01, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=f"dt: got {dt!r}; allowed: .*above 0"):
            loop.step(dt)
    other = finalized(replicated(robot, 3), device).state()
    with pytest.raises(ValueError, match=r"state_in.joint_q: got shape \(24,\); al"):
        loop.solver.step(other, loop.next, loop.control, None, 0.01)
    with pytest.raises(ValueError, match=r"state_out.joint_q: got shape \(24,\); al"):
        loop.solver.step(loop.now, other, loop.control, None, 0.01)
    loop.control.joint_f = None
    with pytest.raises(ValueError, match=r"control.joint_f: got None; allowed: shape"):
        loop.step(0.01)


def test_a_tape_is_refused(tmp_path: Path, device: jax.Device) -> None:
    loop = Loop(off_centre(tmp_path), 1, device)
    with wp.Tape(), pytest.raises(RuntimeError, match=r"inside wp\.Tape"):
        loop.step(0.01)


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
