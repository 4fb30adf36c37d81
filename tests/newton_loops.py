"""Newton's own loop over several worlds of a robot, with the solver."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import newton
import numpy as np
import warp as wp
from urdf_text import row, write

from newton_qd import physics
from newton_qd.assets import find_urdf
from newton_qd.physics.model import newton_builder
from newton_qd.physics.model.description import read_description
from newton_qd.physics.reference import rotation_matrix
from newton_qd.physics.solver import NewtonQDSolver
from newton_qd.robots import ANT, RobotSpec

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
