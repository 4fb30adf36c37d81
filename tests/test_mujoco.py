"""The equations of motion agree with MuJoCo C on the same URDF file.

Mass matrix, bias force and unconstrained acceleration at random states, without
contact: to 1e-5 in float32 and 1e-9 in float64, relative to the robot's own scale
(an entry of the mass matrix to its two diagonal entries, a force or acceleration to
the largest of its vector). In float32 the halfcheetah has 1e-4: a foot has 200 times as
much inertia about the torso, where the kernels add it up, as about its own joint.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from mujoco_reference import MujocoReference
from physics_helpers import DISTINCT

from newton_qd import physics
from newton_qd.assets import find_urdf
from newton_qd.physics import reference
from newton_qd.physics.model import build_system
from newton_qd.physics.system import JointKind, System
from newton_qd.robots import ROBOTS, RobotSpec

STATES = 20
TOLERANCE = {"float32": 1e-5, "float64": 1e-9}
ROUNDED = {("halfcheetah", "float32"): 1e-4}

# Nothing here is aligned, centred or diagonal; "spacer" is a link of a gram that
# makes a joint of two axes.
OFF_CENTRE = """<?xml version="1.0"?>
<robot name="off_centre">
  <link name="base">
    <inertial>
      <origin xyz="0.12 -0.2 0.07" rpy="0.3 -0.5 0.8"/>
      <mass value="3.0"/>
      <inertia ixx="0.20" iyy="0.25" izz="0.30" ixy="0.03" ixz="-0.02" iyz="0.04"/>
    </inertial>
  </link>
  <link name="arm">
    <inertial>
      <origin xyz="0.15 0.02 -0.1" rpy="-0.4 0.2 0.1"/>
      <mass value="1.2"/>
      <inertia ixx="0.05" iyy="0.08" izz="0.06" ixy="-0.01" ixz="0.015" iyz="0.0"/>
    </inertial>
  </link>
  <link name="slider">
    <inertial>
      <origin xyz="-0.05 0.1 0.2" rpy="0.7 0.1 -0.6"/>
      <mass value="0.8"/>
      <inertia ixx="0.03" iyy="0.02" izz="0.04" ixy="0.002" ixz="0.0" iyz="-0.004"/>
    </inertial>
  </link>
  <link name="spacer">
    <inertial>
      <origin xyz="0.01 0.0 0.0"/>
      <mass value="1e-3"/>
      <inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <link name="wrist">
    <inertial>
      <origin xyz="0.0 0.1 0.05" rpy="0.2 0.9 0.0"/>
      <mass value="0.6"/>
      <inertia ixx="0.02" iyy="0.03" izz="0.025" ixy="0.001" ixz="0.0" iyz="0.003"/>
    </inertial>
  </link>
  <joint name="shoulder" type="revolute">
    <parent link="base"/><child link="arm"/>
    <origin xyz="0.3 0.1 -0.05" rpy="0.5 0.4 -0.9"/>
    <axis xyz="0.6 -0.3 0.8"/>
    <limit lower="-2.0" upper="1.5" effort="50" velocity="20"/>
    <dynamics damping="0.7"/>
  </joint>
  <joint name="rail" type="prismatic">
    <parent link="arm"/><child link="slider"/>
    <origin xyz="0.25 -0.05 0.1" rpy="-0.2 0.6 0.3"/>
    <axis xyz="0.0 1.0 -0.5"/>
    <limit lower="-0.3" upper="0.4" effort="50" velocity="20"/>
    <dynamics damping="1.3"/>
  </joint>
  <joint name="swivel" type="continuous">
    <parent link="base"/><child link="spacer"/>
    <origin xyz="-0.2 0.15 0.1" rpy="0.1 -0.3 0.2"/>
    <axis xyz="1 0 0"/>
  </joint>
  <joint name="tilt" type="revolute">
    <parent link="spacer"/><child link="wrist"/>
    <origin xyz="0.05 0.0 0.02" rpy="0.0 0.3 1.1"/>
    <axis xyz="0 1 0"/>
    <limit lower="-1.0" upper="1.0" effort="50" velocity="20"/>
    <dynamics damping="0.2"/>
  </joint>
</robot>
"""


def off_centre_spec(path: Path) -> RobotSpec:
    """Row of the robot without symmetry, without contacts."""
    return RobotSpec(
        name="off_centre",
        urdf=str(path),
        torso="base",
        feet=(),
        actuators=(("rail", 5.0), ("shoulder", 10.0)),
        contacts=(),
        rest_pose=(),
        dt=0.02,
        substeps=2,
    )


CASES = [
    # its self-contacts need kernels of their own
    pytest.param(n, marks=pytest.mark.slow if n == "halfcheetah" else ())
    for n in (*DISTINCT, "off_centre")
]


@pytest.fixture(scope="module", params=CASES)
def robot(request: pytest.FixtureRequest, tmp_path_factory) -> RobotSpec:
    if request.param in ROBOTS:
        return ROBOTS[request.param]
    path = tmp_path_factory.mktemp("urdf") / "off_centre.urdf"
    path.write_text(OFF_CENTRE, encoding="utf-8")
    return off_centre_spec(path)


def random_state(
    system: System, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates (nq,) inside the joint limits and velocities (nv,)."""
    q = rng.normal(size=system.nq)
    for body, kind in enumerate(system.joint_kind):
        start = system.q_start[body]
        if kind == JointKind.FREE:
            q[start + 3 : start + 7] /= np.linalg.norm(q[start + 3 : start + 7])
        else:
            dof = system.v_start[body]
            low = max(system.limit_lower[dof], -np.pi)
            q[start] = rng.uniform(low, min(system.limit_upper[dof], np.pi))
    return q, 2.0 * rng.normal(size=system.nv)


built = functools.cache(build_system)


def error(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Largest difference, relative to the largest entry or 1e-3."""
    return float(np.abs(ours - theirs).max() / max(np.abs(theirs).max(), 1e-3))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_equations_of_motion(robot: RobotSpec, dtype: str) -> None:
    tolerance = ROUNDED.get((robot.name, dtype), TOLERANCE[dtype])
    with jax.enable_x64(True) if dtype == "float64" else contextlib.nullcontext():
        system = built(robot, dtype)
        both = _jitted(_mass_and_bias, system)
        theirs = MujocoReference(find_urdf(robot.urdf), system)
        rng = np.random.default_rng(7)
        for _ in range(STATES):
            # Both see the same rounded numbers.
            q, v = (x.astype(dtype) for x in random_state(system, rng))
            force = rng.normal(size=system.nv) * 10.0
            theirs.set_state(q.astype(np.float64), v.astype(np.float64))
            expected = theirs.mass_matrix()
            scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
            mass, bias = both(q, v)
            assert mass.dtype == bias.dtype == dtype
            assert np.abs((mass - expected) / scale).max() < tolerance
            assert error(bias, theirs.bias_forces()) < tolerance
            right = force - bias.astype(np.float64) - system.damping * v
            acceleration = np.linalg.solve(mass.astype(np.float64), right)
            assert error(acceleration, theirs.acceleration(force)) < tolerance


def _mass_and_bias(system: System, q: Any, v: Any) -> tuple[jax.Array, jax.Array]:
    return physics.mass_matrix(system, q), physics.bias_forces(system, q, v)


def _jitted(function: Callable, system: System) -> Callable[..., Any]:
    compiled = jax.jit(lambda *arguments: function(system, *arguments))
    return lambda *arguments: jax.device_get(compiled(*arguments))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_kinematics(robot: RobotSpec, dtype: str) -> None:
    tolerance = TOLERANCE[dtype]
    with jax.enable_x64(True) if dtype == "float64" else contextlib.nullcontext():
        system = built(robot, dtype)
        compute = _jitted(physics.forward_kinematics, system)
        theirs = MujocoReference(find_urdf(robot.urdf), system)
        rng = np.random.default_rng(8)
        for _ in range(STATES):
            q, v = (x.astype(dtype) for x in random_state(system, rng))
            theirs.set_state(q.astype(np.float64), v.astype(np.float64))
            ours = compute(q, v)
            linear, angular = theirs.body_velocities()
            assert error(ours.position, theirs.body_positions()) < tolerance
            assert error(ours.linear_velocity, linear) < tolerance
            assert error(ours.angular_velocity, angular) < tolerance
            for rotation, name in zip(ours.rotation, system.body_names, strict=True):
                matrix = theirs.data.body(name).xmat.reshape(3, 3)
                turned = reference.rotation_matrix(np.asarray(rotation, np.float64))
                assert error(turned, matrix) < tolerance


def test_numpy_reference(robot: RobotSpec) -> None:
    """The slow reference of the package is a third opinion, in double precision."""
    system = built(robot, "float32")
    theirs = MujocoReference(find_urdf(robot.urdf), system)
    np.testing.assert_array_equal(system.damping, theirs.damping())
    rng = np.random.default_rng(9)
    for _ in range(STATES):
        q, v = random_state(system, rng)
        theirs.set_state(q, v)
        frames = reference.body_frames(system, q)
        assert error(frames[:, :3], theirs.body_positions()) < 1e-12
        linear, angular = reference.jacobians(system, q)
        their_linear, their_angular = theirs.body_velocities()
        assert error(linear @ v, their_linear) < 1e-11
        assert error(angular @ v, their_angular) < 1e-11
        assert error(reference.mass_matrix(system, q), theirs.mass_matrix()) < 1e-11


def test_off_centre_root_matters(tmp_path: Path) -> None:
    """The conversion is not trivial: without it the two mass matrices differ."""
    path = tmp_path / "off_centre.urdf"
    path.write_text(OFF_CENTRE, encoding="utf-8")
    system = build_system(off_centre_spec(path), "float32")
    theirs = MujocoReference(path, system)
    q, v = random_state(system, np.random.default_rng(10))
    theirs.set_state(q, v)
    converted = theirs.mass_matrix()
    theirs.turn = np.eye(system.nv)
    assert error(theirs.mass_matrix(), converted) > 0.01
