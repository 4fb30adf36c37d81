"""Copies of an environment with another robot."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import newton_qd
from newton_qd import physics, tasks
from newton_qd.assets import find_urdf
from newton_qd.envs.ant import Ant
from newton_qd.envs.locomotion import Locomotion
from newton_qd.envs.pointmaze import PointMaze
from newton_qd.envs.swimmer import Swimmer
from newton_qd.robots import (
    ANT,
    HOPPER,
    HUMANOID,
    PUSHER,
    QUADRUPED,
    REACHER,
    SWIMMER,
    Material,
    RobotSpec,
)

KEY = jax.random.key(0)


@pytest.fixture
def hurt(tmp_path: Path) -> RobotSpec:
    """An ant whose first motor is dead in all but name, and whose torso is heavier."""
    text = find_urdf(ANT.urdf).read_text(encoding="utf-8")
    path = tmp_path / "hurt.urdf"
    path.write_text(text.replace('mass value="10.0"', 'mass value="12.0"', 1))
    weak = (ANT.actuators[0][0], 0.01), *ANT.actuators[1:]
    return dataclasses.replace(ANT, name="hurt", urdf=str(path), actuators=weak)


def test_another_robot_in_the_same_task(hurt: RobotSpec) -> None:
    ant = Ant(healthy_reward=7.0)
    changed = ant.with_robot(hurt)
    assert changed.robot is hurt and ant.robot is ANT
    assert changed.name == "hurt"
    torso = ant.system.torso
    assert (ant.system.mass[torso], changed.system.mass[torso]) == (10, 12)
    assert changed.system.gear[0] == 0.01
    assert changed.observation_layout == ant.observation_layout
    after = jax.jit(changed.step)(changed.reset(KEY), np.zeros(8, np.float32))
    assert float(after.metrics["reward_survive"]) == 7.0
    assert changed.with_robot(ANT).system is ant.system


def _changed(robot: RobotSpec, path: Path, pattern: str, by: str) -> RobotSpec:
    """Returns the robot with another text in its URDF file, under the name of it."""
    text = find_urdf(robot.urdf).read_text(encoding="utf-8")
    changed, count = re.subn(pattern, by, text, flags=re.DOTALL)
    assert count
    path.write_text(changed, encoding="utf-8")
    return dataclasses.replace(robot, name=path.stem, urdf=str(path))


def test_the_centre_of_a_swimmer_is_that_of_its_masses(tmp_path: Path) -> None:
    pattern = r'(<link name="back">\s*<inertial>.*?<mass value=")[^"]*'
    heavy = _changed(SWIMMER, tmp_path / "heavy.urdf", pattern, r"\g<1>9.0")
    env = Swimmer().with_robot(heavy)
    start = jax.jit(env.reset)(KEY)
    after = jax.jit(env.step)(start, np.array([1.0, -1.0], np.float32))
    share = env.system.mass / env.system.mass.sum()
    assert share.max() > 0.9

    def centre(state: Any) -> np.ndarray:
        found = state.pipeline_state
        seen = physics.forward_kinematics(env.system, found.q, found.v)
        return share @ np.asarray(seen.com, np.float64)[:, :2]

    velocity = (centre(after) - centre(start)) / env.dt
    named = after.metrics["x_velocity"], after.metrics["y_velocity"]
    np.testing.assert_allclose(named, velocity, atol=1e-4)
    place = after.metrics["x_position"], after.metrics["y_position"]
    np.testing.assert_allclose(place, centre(after), atol=1e-6)


def test_tasks_keep_wrappers_scene_and_softness(hurt: RobotSpec) -> None:
    whole = newton_qd.create("ant_uni", 5)
    env: Any = newton_qd.create("ant_uni", 5, robot=hurt)
    assert env.robot is hurt and env.state_descriptor_length == 4
    assert env.observation_size == whole.observation_size
    other: Any = whole.with_robot(hurt)
    assert other.system is env.system
    soft: Any = newton_qd.create("anttrap", robot=hurt, material=Material(friction=0.3))
    assert soft.robot == dataclasses.replace(hurt, material=Material(friction=0.3))
    own: Any = newton_qd.create("anttrap").unwrapped
    assert soft.system.scene is own.system.scene is not None


def test_a_base_that_takes_a_robot_gets_it(
    hurt: RobotSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tasks, "ENVIRONMENTS", dict(tasks.ENVIRONMENTS))
    newton_qd.register("run", Locomotion, robot=ANT)
    run: Any = newton_qd.create("run", robot=hurt)
    assert run.robot is hurt
    newton_qd.register("any", _any)
    own: Any = newton_qd.create("any", robot=QUADRUPED)  # which has other joints
    assert own.robot is QUADRUPED
    options: Any = {"robot": "small"}
    newton_qd.register("sized", _sized)
    assert newton_qd.create("sized", **options).unwrapped.name == "small"


def _any(**options: Any) -> newton_qd.Env:
    return Locomotion(**{"robot": ANT, **options})


def _sized(robot: str = "large") -> newton_qd.Env:
    """An environment whose argument ``robot`` is no spec."""
    return Ant().with_robot(dataclasses.replace(ANT, name=robot))


def test_robots_that_do_not_fit_are_refused(hurt: RobotSpec, tmp_path: Path) -> None:
    words = r"robot: got hopper, whose joints are .*; allowed: a robot with the joints"
    with pytest.raises(ValueError, match=words):
        Ant().with_robot(HOPPER)
    turned = dataclasses.replace(hurt, actuators=hurt.actuators[::-1])
    words = "robot: got hurt, whose actuators are .*; allowed: .* the actuators of this"
    with pytest.raises(ValueError, match=words):
        newton_qd.create("ant_uni", robot=turned)
    lame = dataclasses.replace(hurt, feet=hurt.feet[:2])
    words = "whose torso and feet are .*; allowed: .* the torso and feet of this task: "
    with pytest.raises(ValueError, match=words):
        newton_qd.create("ant_uni", robot=lame)
    text = find_urdf(REACHER.urdf).read_text(encoding="utf-8")
    path = tmp_path / "renamed.urdf"  # the task asks for the tip of body1
    path.write_text(text.replace('"body1"', '"hand"'))
    renamed = dataclasses.replace(REACHER, name="renamed", urdf=str(path))
    words = (
        "robot: got renamed, whose links are .*hand.*; allowed: .* the links of this"
    )
    with pytest.raises(ValueError, match=words):
        newton_qd.create("reacher", robot=renamed)
    with pytest.raises(TypeError, match=r"robot: got 'ant'; allowed: .*RobotSpec"):
        newton_qd.create("ant", robot="ant")  # type: ignore[arg-type]
    with pytest.raises(NotImplementedError, match="pointmaze is not a simulated robot"):
        PointMaze().with_robot(ANT)
    with pytest.raises(NotImplementedError, match="pointmaze is not a simulated robot"):
        newton_qd.create("pointmaze", robot=ANT)


def test_more_links_may_be_fixed_to_the_world(tmp_path: Path) -> None:
    """A robot in front of a lamp: no task reads the lamp."""
    lamp = (
        '<joint name="stand" type="fixed"><parent link="world"/><child link="lamp"/>'
        '<origin xyz="0 9 1"/></joint><link name="lamp"/></robot>'
    )
    for name, robot in (("hopper", HOPPER), ("pusher", PUSHER)):
        lit = _changed(robot, tmp_path / f"{name}_lit.urdf", "</robot>", lamp)
        env: Any = newton_qd.create(name, robot=lit)
        assert "lamp" in env.system.scene_links
        after = jax.jit(env.reset)(KEY)
        expected = jax.jit(newton_qd.create(name).reset)(KEY)
        np.testing.assert_array_equal(after.obs, expected.obs)
    free = '<link name="world"/><joint name="root" type="floating">'
    free += '<parent link="world"/><child link="torso"/></joint>'
    lit = _changed(ANT, tmp_path / "ant_lit.urdf", "</robot>", free + lamp)
    newton_qd.create("ant", robot=lit, use_contact_forces=False)
    with pytest.raises(ValueError, match="whose observations have length"):
        newton_qd.create("ant", robot=lit)


def test_robots_with_other_observations_are_refused(tmp_path: Path) -> None:
    """The humanoid observes each link with mass, the pusher a link that is fixed."""
    moments = 'ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"'
    inertial = f'<mass value="0.001"/><inertia {moments}/>'
    by = rf'<link name="\1"><inertial>{inertial}</inertial></link>'
    full = _changed(HUMANOID, tmp_path / "full.urdf", r'<link name="(\w+)"/>', by)
    words = (
        "robot: got full, whose observations have length 332; allowed: a robot whose "
        "observations have length 227"
    )
    with pytest.raises(ValueError, match=words):
        newton_qd.create("humanoid", robot=full)
    aimless = _changed(PUSHER, tmp_path / "aimless.urdf", '"goal"', '"aim"')
    words = "robot: got aimless, whose fixed links are mount, aim; allowed: .* goal"
    with pytest.raises(ValueError, match=words):
        newton_qd.create("pusher", robot=aimless)
    for change in ({"feet": ()}, {"torso": ANT.feet[0]}):
        other = dataclasses.replace(ANT, **change)
        with pytest.raises(ValueError, match=r"whose torso and feet are .*; allowed"):
            newton_qd.create("ant", robot=other)
