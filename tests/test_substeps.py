"""How many substeps a robot needs: the two bounds, the warning, and measured energy."""

from __future__ import annotations

import dataclasses
import itertools
import linecache
import warnings
from pathlib import Path
from typing import Any

import energy_helpers as energies
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hexapod import GEAR, hexapod
from physics_helpers import report
from subjects import ACTIONS, from_system
from urdf_text import joint, link, robot_text, row, sphere, write

from newton_qd import physics
from newton_qd.envs.base import PhysicsEnv
from newton_qd.physics import reference
from newton_qd.physics.model import build_system
from newton_qd.physics.model.substeps import (
    LARGEST_PHASE,
    LARGEST_TURN,
    contact_masses,
    inner_torques,
    iterates,
    joint_speeds,
    needed_substeps,
)
from newton_qd.physics.system import System
from newton_qd.robots import ACROBOT, HALFCHEETAH, ROBOTS, Contact, Material, RobotSpec

INERTIA, MASS, ARM = 0.5, 2.0, 0.3


def arm(
    folder: Path, damping: float = 0.0, limits: str = "", **changes: object
) -> RobotSpec:
    """A link on a hinge of the world, with a motor, and a sphere at its end."""
    inside = f'<axis xyz="0 1 0"/><dynamics damping="{damping}"/>{limits}'
    text = robot_text(
        '<link name="world"/>',
        joint("j", "revolute" if limits else "continuous", "world", "arm", inside),
        f"""<link name="arm"><inertial><origin xyz="{ARM} 0 0"/><mass value="{MASS}"/>
        <inertia ixx="1" iyy="{INERTIA - MASS * ARM**2}" izz="1" ixy="0" ixz="0"
        iyz="0"/></inertial>{sphere(0.05, f"{2 * ARM} 0 0")}</link>""",
    )
    one = row(write(folder, text), "arm", actuators=(("j", 4.0),))
    return dataclasses.replace(one, contacts=(Contact("arm"),), **changes)


def speed(robot: RobotSpec) -> float:
    return float(joint_speeds(build_system(robot, "float32")).max())


def test_speed_of_a_joint(tmp_path: Path) -> None:
    """Closed form: the work of the motor over its range becomes kinetic energy.

    Where limits give energy back, the motor does its work twice.
    """
    bounded = '<limit lower="-0.5" upper="1.0" effort="1" velocity="1"/>'
    expected = np.sqrt(2 * 4.0 * 1.5 / INERTIA)
    held = arm(tmp_path, limits=bounded, material=Material(limit_dissipation=0.5))
    assert speed(held) == pytest.approx(expected)
    expected *= np.sqrt(2)
    assert speed(arm(tmp_path, limits=bounded)) == pytest.approx(expected)
    turn = np.sqrt(2 * 2 * 4.0 * 2 * np.pi / INERTIA)
    assert speed(arm(tmp_path)) == pytest.approx(turn)
    # damping takes up 4 N m
    assert speed(arm(tmp_path, damping=2.0)) == pytest.approx(2.0)
    assert speed(arm(tmp_path, actuators=())) == 0.0


def test_fastest_joint_of_a_given_energy() -> None:
    """No velocity with this kinetic energy turns the joint faster."""
    system = build_system(HALFCHEETAH, "float32")
    mass = reference.mass_matrix(system, system.rest_q)
    for gear, dof in zip(system.gear, system.control_dof, strict=True):
        work = gear * (system.limit_upper[dof] - system.limit_lower[dof])
        v = np.linalg.solve(mass, np.eye(system.nv)[dof])
        v *= np.sqrt(2 * work / (v @ mass @ v))
        assert joint_speeds(system)[dof] == pytest.approx(v[dof])


def test_joint_without_motor(tmp_path: Path) -> None:
    """It gets the work of the strongest motor; slides and the root do not count."""
    acrobot = build_system(ACROBOT, "float32")
    (driven,) = acrobot.control_dof
    speeds = joint_speeds(acrobot)
    assert (speeds > 0).all() == (acrobot.parent >= 0).all()
    assert speeds[driven] > 0
    free = build_system(hexapod(tmp_path, 0.0), "float32")
    assert (joint_speeds(free)[:6] == 0).all() and (joint_speeds(free)[6:] > 0).all()


def test_a_hinge_behind_links_without_mass_is_turned(tmp_path: Path) -> None:
    """Two axes in a row, as of a hip: a mass before both of them carries both."""
    chain = ("trunk", "axis", "leg")
    text = robot_text(
        *(link("trunk"), '<link name="axis"/>', link("leg")),
        *(joint(f"to_{b}", "continuous", a, b) for a, b in itertools.pairwise(chain)),
    ).replace('<child link="leg"/>', '<child link="leg"/><axis xyz="0 1 0"/>')
    robot = row(write(tmp_path, text), "trunk", actuators=(("to_leg", 4.0),))
    torques = inner_torques(build_system(robot, "float32"))
    assert torques.tolist() == [0.0] * 6 + [4.0, 4.0]


def test_mass_of_a_contact(tmp_path: Path) -> None:
    """Closed form: inertia over the squared arm; a free ball has its mass."""
    system = build_system(arm(tmp_path), "float32")
    assert contact_masses(system) == pytest.approx([INERTIA / (2 * ARM) ** 2])
    text = f"""<robot name="b"><link name="b"><inertial><mass value="3"/><inertia
    ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>{sphere(0.1)}
    </link></robot>"""
    ball = row(write(tmp_path, text), "b", contacts=(Contact("b"),))
    assert contact_masses(build_system(ball, "float32")) == pytest.approx([3.0])


def test_number(tmp_path: Path) -> None:
    """The larger of both bounds, and never more than 10 ms; whole numbers are exact."""
    fast = arm(tmp_path, damping=0.01, actuators=(("j", 4e3),))
    dt = 7.0 * LARGEST_TURN / speed(fast)
    assert dt < 0.01
    system = build_system(dataclasses.replace(fast, dt=dt), "float32")
    assert needed_substeps(system)[0] == pytest.approx(7.0)
    assert physics.recommended_substeps(system) == 7
    firm = arm(tmp_path, damping=100.0)
    one = build_system(firm, "float32")
    frequency = np.sqrt(one.contact_stiffness / contact_masses(one)[0])
    dt = 5.0 * LARGEST_PHASE / frequency
    needed = needed_substeps(build_system(dataclasses.replace(firm, dt=dt), "float32"))
    assert needed[1] == pytest.approx(5.0)
    slow = dataclasses.replace(firm, dt=0.05, contacts=())
    assert physics.recommended_substeps(build_system(slow, "float32")) == 5


@pytest.mark.parametrize("name", ROBOTS)
def test_suite_has_enough(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        system = physics.load_system(ROBOTS[name])
    recommended = physics.recommended_substeps(system)
    report(f"{name}: substeps, recommended", (system.substeps, recommended))
    assert 1 <= recommended <= system.substeps


def test_none_takes_the_recommended_number(tmp_path: Path) -> None:
    robot = hexapod(tmp_path, 0.0, substeps=None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        system = physics.load_system(robot)
    again = physics.load_system(dataclasses.replace(robot, substeps=17), "float32")
    assert system.substeps == system.robot.substeps == again.substeps == 17
    assert physics.recommended_substeps(again) == 17
    assert system.h == pytest.approx(0.02 / 17)
    assert physics.load_system(robot) is system


def test_a_warning_is_about_the_line_that_called_the_package(tmp_path: Path) -> None:
    """Not about a line of the package, however deep in it the reason is."""
    robot = hexapod(tmp_path, 0.0)

    class Own(PhysicsEnv):
        def outcome(self, before: Any, after: Any, action: Any) -> Any:
            return after.q[0], False, {}

    for call in (physics.load_system, Own):
        with pytest.warns(physics.FewSubstepsWarning) as seen:
            call(robot)
        assert len(seen) == 1 and seen[0].filename == __file__
        line = linecache.getline(__file__, seen[0].lineno)
        assert line.strip() == "call(robot)"


def test_few_substeps_give_a_warning(tmp_path: Path) -> None:
    """It names the robot, its number, the reason, and the number that is enough."""
    folders = [tmp_path / "undamped", tmp_path / "damped"]
    for folder in folders:
        folder.mkdir()
    fast = hexapod(folders[0], 0.0)
    expected = (
        r"robot 'hexapod', substeps: got 4, joint 'tibia_.*' can turn by 1.7 rad in "
        r"one; allowed: 17 or more, or None, .* more damping"
    )
    with pytest.warns(physics.FewSubstepsWarning, match=expected):
        physics.load_system(fast)
    stiff = hexapod(folders[1], 0.2, material=Material(static_penetration=2e-4))
    expected = (
        r"got 4, a contact of 'tibia_.*' moves 0.033 kg, too little for 5.52e\+04 N/m; "
        r"allowed: 15 or more, or None, .*static_penetration"
    )
    with pytest.warns(physics.FewSubstepsWarning, match=expected):
        physics.load_system(stiff)
    for robot in (
        dataclasses.replace(fast, substeps=17),
        dataclasses.replace(stiff, substeps=15),
        hexapod(folders[1], 0.2),
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            physics.load_system(robot)


def stiff(folder: Path, substeps: int | None) -> System:
    """A damped hexapod on ground that is too stiff for four substeps."""
    material = Material(static_penetration=2e-4, smoothing=0.005)
    robot = hexapod(folder, 0.2, substeps=substeps, material=material)
    return build_system(robot, "float64")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ACTIONS)
def test_recommended_number_is_enough(tmp_path: Path, x64: None, kind: str) -> None:
    """Nothing is gained with it, and much with the number that gives a warning."""
    gains = {}
    for substeps in (4, None):
        one = from_system("stiff", stiff(tmp_path, substeps))
        found = energies.judge(energies.driven(one, kind, 64, 100))
        gains[one.system.substeps] = found
    report(f"{kind}: gain of a substep, {GEAR} N m", gains)
    assert list(gains) == [4, 15]
    assert gains[4].worlds > 0.02
    assert gains[15].substeps == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("damping", [0.01, 0.0])
def test_fast_hexapod_has_enough(tmp_path: Path, x64: None, damping: float) -> None:
    system = build_system(hexapod(tmp_path, damping, substeps=None), "float64")
    one = from_system("hexapod", system)
    found = energies.judge(energies.driven(one, "bang-bang", 64, 100))
    report(f"damping {damping}: gain of a substep", found)
    assert found.substeps == 0.0 and found.faults == 0.0


STICK = """<robot name="stick"><link name="stick"><inertial><mass value="1"/>
  <inertia ixx="4e-4" iyy="{y}" izz="{z}" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><geometry><sphere radius="0.05"/></geometry></collision></link></robot>"""


def test_a_body_that_tumbles_keeps_its_energy(tmp_path: Path, x64: None) -> None:
    """With velocity products of the start of a substep, the factor is 650."""
    path = write(tmp_path, STICK.format(y=0.03, z=0.03))
    robot = row(path, "stick", contacts=(Contact("stick"),), gravity=0.0)
    system = build_system(robot, "float64")
    q = jnp.asarray(system.rest_q).at[2].set(50.0)
    v = jnp.array([0.0, 0.0, 0.0, 15.0, 10.0, 3.0])
    state = physics.initial_state(system, q, v)
    step = jax.jit(lambda state: physics.step(system, state, jnp.zeros(0))[0])

    def energy(state: physics.PhysicsState) -> float:
        return float(state.v @ physics.mass_matrix(system, state.q) @ state.v) / 2

    first = energy(state)
    for _ in range(60):
        state = step(state)
    assert 0.9 < energy(state) / first < 1.01


def test_a_ball_does_not_tumble(tmp_path: Path) -> None:
    text = STICK.format(y=4e-4, z=4e-4)
    robot = row(write(tmp_path, text), "stick", contacts=(Contact("stick"),))
    assert not iterates(build_system(robot, "float32"))
    # about the origin of its frame, the moments are not equal
    text = text.replace("<inertial>", '<inertial><origin xyz="2e-3 0 0"/>')
    robot = dataclasses.replace(robot, urdf=write(tmp_path, text))
    assert iterates(build_system(robot, "float32"))
