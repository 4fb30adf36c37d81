"""Quaternions of a free root: any length above 0 is a rotation."""

from __future__ import annotations

import functools
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import newton_qd
from newton_qd import physics
from newton_qd.physics.reference import origin_axes
from newton_qd.robots import ANT, RobotSpec

SYSTEM = physics.load_system(ANT)
REST = np.asarray(SYSTEM.rest_q, np.float32)
STILL = np.zeros(SYSTEM.nv, np.float32)
ARM_AND_BALL = """<robot name="arm">
<link name="world"/>
<link name="arm"><inertial><mass value="1"/><origin xyz="0 0 0.2"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="ball"><inertial><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="turn" type="revolute"><parent link="world"/><child link="arm"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="free" type="floating"><parent link="world"/><child link="ball"/>
</joint></robot>"""


def turned(length: float) -> np.ndarray:
    """Coordinates with a quaternion of this length."""
    q = REST.copy()
    q[2] = 2.0
    unit = np.array([0.5, -0.1, 0.3, 0.8]) / np.sqrt(0.99)
    q[3:7] = unit.astype(np.float32) * np.float32(length)
    return q


TURNED = turned(1.0)


@jax.jit
def stepped(q: jax.Array) -> tuple[jax.Array, jax.Array]:
    still, action = jnp.asarray(STILL), jnp.zeros(SYSTEM.nu)
    state, fault = physics.step(SYSTEM, physics.initial_state(SYSTEM, q, still), action)
    return state.q, fault


@pytest.mark.parametrize("length", [2e-30, 0.2, 1.1, 30.0, 1e25])
def test_the_length_of_a_quaternion_changes_nothing(length: float) -> None:
    expected, _ = stepped(TURNED)
    found, fault = stepped(turned(length))
    assert fault == 0
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_a_unit_quaternion_stays_the_same() -> None:
    found = physics.unit_quaternions(SYSTEM, jnp.asarray(TURNED))
    np.testing.assert_array_equal(found, TURNED)


def test_lengths_near_one_are_corrected_too() -> None:
    found = physics.unit_quaternions(SYSTEM, jnp.asarray(turned(1.002)))
    np.testing.assert_allclose(found, TURNED, atol=1e-6)


def test_coordinates_are_checked() -> None:
    wrong: Any
    for wrong in (np.arange(15), TURNED.tolist()):
        with pytest.raises(TypeError, match=r"^q: got .*; allowed: an array of shape"):
            physics.unit_quaternions(SYSTEM, wrong)
    with pytest.raises(ValueError, match=r"^q: got an array of shape \(2,\)"):
        physics.unit_quaternions(SYSTEM, jnp.asarray(STILL[:2]))


def test_a_quaternion_of_length_zero_is_a_fault() -> None:
    assert stepped(turned(0.0))[1] == 1


def test_the_way_along_a_quaternion_has_no_gradient() -> None:
    """Its length does not matter."""
    q = turned(2.0)
    gradient = np.asarray(jax.jit(jax.grad(lambda q: stepped(q)[0][3]))(q))
    assert np.isfinite(gradient).all() and np.abs(gradient[3:7]).max() > 1e-5
    np.testing.assert_allclose(gradient[3:7] @ q[3:7], 0.0, atol=1e-6)


def test_a_pose_of_ones_own_may_have_any_quaternion() -> None:
    class Tumbling(type(newton_qd.create("ant").unwrapped)):
        def reset_pose(self, rng: jax.Array, q: jax.Array) -> jax.Array:
            return q.at[3:7].set(jax.random.normal(rng, (4,), q.dtype))

    env: Any = Tumbling()  # pyright: ignore[reportAbstractUsage]
    q = jax.jit(env.reset)(jax.random.key(0)).pipeline_state.q
    np.testing.assert_allclose(np.linalg.norm(q[3:7]), 1.0, rtol=1e-6)
    lowest = jax.jit(functools.partial(physics.lowest_contact, env.system))
    assert abs(lowest(q)) < 1e-5


def test_coordinates_of_a_wrong_shape_are_refused() -> None:
    rest, still = jnp.asarray(REST), jnp.asarray(STILL)
    with pytest.raises(ValueError, match=r"q: got .*\(3,\), .*; allowed: .*\(15,\)"):
        physics.initial_state(SYSTEM, rest[:3], still)
    with pytest.raises(ValueError, match=r"v: got .*\(3,\), .*; allowed: .*\(14,\)"):
        physics.initial_state(SYSTEM, rest, still[:3])


def test_an_object_after_an_arm_gives_no_warning(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(ARM_AND_BALL, encoding="utf-8")
    robot = RobotSpec(
        name="arm", urdf=str(path), torso="ball", dt=0.02, actuators=(("turn", 1.0),)
    )
    system = physics.load_system(robot)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not origin_axes(system).any()
