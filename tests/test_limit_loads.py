"""The weight on the limits of joints, and the warning about limits that give way."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import numpy as np
import pytest
from urdf_text import heavy, joint, robot_text, row, write

from newton_qd.physics import SoftLimitWarning, load_system, reference
from newton_qd.physics.model.limit_loads import limit_loads
from newton_qd.physics.system import System
from newton_qd.robots import Material, RobotSpec

ARM = """<link name="arm"><inertial><origin xyz="0.5 0 0"/><mass value="30"/>
  <inertia ixx="0.1" iyy="2.5" izz="2.5" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
WEIGHT = 30 * 9.81  # [N]


def held(
    folder: Path,
    kind: str,
    axis: str,
    ends: tuple[float, float] = (-0.5, 0.5),
    **changes: object,
) -> RobotSpec:
    """A heavy arm that lies, on a joint of the world."""
    lower, upper = ends
    inside = f'<axis xyz="{axis}"/><limit lower="{lower}" upper="{upper}"/>'
    text = robot_text(
        '<link name="world"/>', joint("held", kind, "world", "arm", inside), ARM
    )
    return row(write(folder, text), "arm", gravity=9.81, substeps=None, **changes)


@pytest.mark.parametrize(
    ("kind", "axis", "load"),
    [
        ("revolute", "0 1 0", WEIGHT * 0.5 * math.cos(0.5)),
        ("revolute", "0 0 1", 0.0),
        ("prismatic", "0 0 1", WEIGHT),
        ("prismatic", "1 0 0", 0.0),
    ],
)
def test_weight_on_a_limit(tmp_path: Path, kind: str, axis: str, load: float) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SoftLimitWarning)
        system = load_system(held(tmp_path, kind, axis))
    np.testing.assert_allclose(limit_loads(system), load, atol=1e-9)


def potential_energy(system: System, q: np.ndarray) -> float:
    frames = reference.body_frames(system, q)
    heights = [
        frame[2] + (reference.rotation_matrix(frame[3:]) @ com)[2]
        for frame, com in zip(frames, system.com, strict=True)
    ]
    return system.robot.gravity * float(system.mass @ np.array(heights))


def test_loads_are_slopes_of_the_potential_energy(tmp_path: Path) -> None:
    """Of skew joints in a chain, with limits that are not symmetric."""
    kinds = ("revolute", "prismatic", "revolute")
    ends = ((-0.3, 0.9), (-0.2, 0.5), (-1.4, 0.2))
    names = ("world", "a", "b", "c")
    turned = '<origin xyz="0.2 -0.1 0.3" rpy="0.4 -0.7 0.2"/>'
    joints = [
        joint(
            f"to_{child}",
            kind,
            parent,
            child,
            f'{turned}<axis xyz="{axis}"/><limit lower="{low}" upper="{high}"/>',
        )
        for kind, (low, high), parent, child, axis in zip(
            kinds,
            ends,
            names,
            names[1:],
            ("0 1 0.3", "1 0.2 0.5", "-0.4 -1 0"),
            strict=False,
        )
    ]
    links = [
        heavy(name, mass, com, "0.1 0.2 0.15")
        for name, mass, com in (
            ("a", 2.0, "0.3 0.1 -0.2"),
            ("b", 1.5, "-0.1 0.4 0.2"),
            ("c", 0.7, "0.2 0.3 0.5"),
        )
    ]
    pose = (("to_a", 0.5), ("to_b", 0.2), ("to_c", -0.6))
    text = robot_text('<link name="world"/>', *links, *joints)
    robot = row(write(tmp_path, text), "a", gravity=3.7, rest_pose=pose)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        system = load_system(robot)
    expected = []
    for dof, limits in enumerate(ends):
        out = []
        for limit, sign in zip(limits, (-1, 1), strict=True):
            q = system.rest_q.copy()
            energies = []
            for step in (1e-5, -1e-5):
                q[dof] = limit + step
                energies.append(potential_energy(system, q))
            out.append(-sign * (energies[0] - energies[1]) / 2e-5)
        expected.append(max(0.0, *out))
    assert min(expected) > 0.1
    np.testing.assert_allclose(limit_loads(system), expected, rtol=1e-7)


def test_limits_that_give_way_are_named(tmp_path: Path) -> None:
    """A motor of 50 N m is too weak, and one of 70 N m is enough."""
    with pytest.warns(SoftLimitWarning, match="limits of 'held': got a weight of 129"):
        load_system(held(tmp_path, "revolute", "0 1 0", actuators=(("held", 50.0),)))
    with warnings.catch_warnings():
        warnings.simplefilter("error", SoftLimitWarning)
        load_system(held(tmp_path, "revolute", "0 1 0", actuators=(("held", 70.0),)))


def test_a_range_shorter_than_the_way_past_a_limit_is_named(tmp_path: Path) -> None:
    """The default limits hold a finger of 2 cm only 10 cm past its end."""
    finger = {"ends": (-0.01, 0.01), "actuators": (("held", 10.0),)}
    named = "limits of 'held': got a range of 0.02 m; allowed: at least 0.1 m"
    with pytest.warns(SoftLimitWarning, match=named):
        load_system(held(tmp_path, "prismatic", "1 0 0", **finger))
    with warnings.catch_warnings():
        warnings.simplefilter("error", SoftLimitWarning)
        # as long as the way past a limit, and computed as 0.09999999999999999
        exact = {**finger, "ends": (-0.01, 0.09)}
        load_system(held(tmp_path, "prismatic", "1 0 0", **exact))
        stiff = Material(limit_overshoot=0.002)
        load_system(held(tmp_path, "prismatic", "1 0 0", material=stiff, **finger))
