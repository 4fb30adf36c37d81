"""How the substeps of a robot are solved: the rule, and what it says of the suite."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hexapod import GEAR, hexapod
from physics_helpers import report
from urdf_text import joint, link, robot_text, row, sphere, write

from newton_qd import physics
from newton_qd.physics.model import build_system
from newton_qd.physics.stepping import FAST_TURN, Solves, fastest_turns, substep_solves
from newton_qd.physics.system import System
from newton_qd.robots import ROBOTS, Contact

ONE, THREE = Solves(iterations=1, solves=3), Solves(iterations=3, solves=1)
SUITE = {
    "ant": ONE,
    "halfcheetah": THREE,
    "hopper": ONE,
    "humanoid": ONE,
    "humanoidstandup": ONE,
    "walker2d": ONE,
    "fetch": ONE,
    "grasp": ONE,
    "pusher": ONE,
    "acrobot": THREE,
    "inverted_double_pendulum": THREE,
    "inverted_pendulum": THREE,
    "reacher": THREE,
    "reacherangle": THREE,
    "swimmer": THREE,
    "ur5e": THREE,
    "quadruped": ONE,
}


def test_suite() -> None:
    """Robots without contacts, and with fast joints, update velocity products."""
    found = {name: physics.load_system(robot) for name, robot in ROBOTS.items()}
    for name, system in found.items():
        turns = fastest_turns(system)
        assert turns.shape == (system.nv,)
        report(f"{name}, largest turn [rad]", turns.max(initial=0.0))
    assert {name: substep_solves(system) for name, system in found.items()} == SUITE


def arm(
    folder: Path,
    damping: float,
    gear: float = 2.0,
    root: str = "torso",
    kind: str = "continuous",
    **changes: object,
) -> System:
    """A link on a torso, which is on the ground; its own joint has a motor."""
    inside = f'<axis xyz="0 1 0"/><dynamics damping="{damping}"/>'
    inside += '<limit lower="-1e10" upper="1e10" effort="1" velocity="1"/>'
    parts = (
        link("torso", sphere(0.1)),
        link("arm"),
        joint("j", kind, root, "arm", inside),
    )
    if root == "world":
        free = '<link name="world"/>' + joint(
            "t", "prismatic", "world", "torso", inside
        )
        parts = (free, *parts)
    robot = row(
        write(folder, robot_text(*parts)),
        "torso",
        actuators=(("j", gear),) if gear else (),
        contacts=(Contact("torso"),),
        dt=0.01,
        substeps=2,
    )
    return build_system(dataclasses.replace(robot, **changes), "float32")


def test_final_speed_of_a_joint(tmp_path: Path) -> None:
    """h gear / damping; a joint without motor has the robot's largest gear, or 1."""
    system = arm(tmp_path, damping=0.5)
    turns = fastest_turns(system)
    np.testing.assert_array_equal(turns[:6], 0.0)  # the free root
    assert turns[6] == pytest.approx(0.005 * 2.0 / 0.5)
    assert fastest_turns(arm(tmp_path, 0.5, substeps=1))[6] == pytest.approx(0.04)
    assert fastest_turns(arm(tmp_path, 0.5, gear=0.0))[6] == pytest.approx(0.01)


def test_joints_that_no_inner_torque_turns_do_not_count(tmp_path: Path) -> None:
    """A slide of an arm, and a hinge between the world and the first mass."""
    assert fastest_turns(arm(tmp_path, 0.0, kind="prismatic")).max() == 0.0
    assert fastest_turns(arm(tmp_path, 0.0, root="world")).max() == 0.0


@pytest.mark.parametrize("damping", [0.0, 0.01])
def test_undamped_joint_has_three_iterations(tmp_path: Path, damping: float) -> None:
    """On the arm, and on the hexapod of the tests."""
    assert substep_solves(arm(tmp_path, damping)) == THREE
    system = build_system(hexapod(tmp_path, damping), "float32")
    report("turn of the hexapod [rad]", fastest_turns(system).max())
    assert substep_solves(system) == THREE


def test_rule_switches_at_the_bound(tmp_path: Path) -> None:
    """Damping on both sides of the bound, of the arm and of the hexapod."""
    for share, solves in ((0.99, ONE), (1.01, THREE)):
        assert (
            substep_solves(arm(tmp_path, 0.005 * 2.0 / (share * FAST_TURN))) == solves
        )
        robot = hexapod(tmp_path, 1.0)
        assert robot.substeps is not None
        damping = robot.dt / robot.substeps * GEAR / (share * FAST_TURN)
        system = build_system(hexapod(tmp_path, damping), "float32")
        assert substep_solves(system) == solves


def test_robot_without_contacts_has_three_iterations(tmp_path: Path) -> None:
    """However much its joints are damped."""
    assert substep_solves(arm(tmp_path, damping=100.0)) == ONE
    assert substep_solves(arm(tmp_path, damping=100.0, contacts=())) == THREE
