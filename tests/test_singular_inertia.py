"""A robot whose joints move singular inertia is refused at load, by link."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import jax.numpy as jnp
import newton
import numpy as np
import pytest
from physics_helpers import report, rollout
from urdf_text import built, heavy, joint, link, refusal, robot_text, row, write

from newton_qd.physics import reference
from newton_qd.physics.model import (
    RobotDescriptionError,
    build_system,
    inertia,
    load_system,
)
from newton_qd.robots import ROBOTS, RobotSpec

CARTPOLE = Path(newton.__file__).parent / "examples" / "assets" / "cartpole.urdf"


def test_cartpole_of_newton_needs_a_fixed_base() -> None:
    """Its root is a rail without mass. Newton's example fixes it to the world."""
    robot = RobotSpec("cartpole", str(CARTPOLE), "cart")
    with pytest.raises(
        RobotDescriptionError,
        match=r"cartpole.urdf: inertia of the floating root link 'slider' and all .*"
        r"allowed: .* <inertial> on 'slider', or fixed_base=True",
    ):
        build_system(robot, "float32")
    fixed = RobotSpec("cartpole", str(CARTPOLE), "cart", fixed_base=True)
    system = build_system(fixed, "float32")
    assert system.joint_names == ("slider_to_cart", "cart_to_pole1", "pole1_to_pole2")


def test_massless_floating_root(tmp_path: Path) -> None:
    hinge = joint("hinge", "continuous", "rail", "cart", '<axis xyz="0 0 1"/>')
    text = robot_text('<link name="rail"/>', link("cart"), hinge)
    message = refusal(tmp_path, text, "cart")
    assert "inertia of the floating root link 'rail' and all that" in message
    weld = text.replace("continuous", "fixed")
    assert built(tmp_path, weld, "cart").nv == 6


def chain(axes: dict[str, str], tip: str | None = None) -> str:
    """Hinges from the world to a link with mass, with massless links between."""
    names = list(axes)
    parts = ['<link name="world"/>']
    for place, name in enumerate(names):
        inner = place < len(names) - 1
        parts.append(f'<link name="{name}"/>' if inner else tip or link(name))
        parent = names[place - 1] if place else "world"
        axis = f'<axis xyz="{axes[name]}"/>'
        parts.append(joint(f"to_{name}", "continuous", parent, name, axis))
    return robot_text(*parts)


def test_two_joints_about_one_axis(tmp_path: Path) -> None:
    text = chain({"ring": "0 0 1", "ball": "0 0 1"})
    message = refusal(tmp_path, text, "ball")
    assert "link 'ring' and all that hangs on it, which joint 'to_ring'" in message


def test_a_ball_joint_of_hinges(tmp_path: Path) -> None:
    """Singular only where two axes are parallel, and there it is refused."""
    text = chain({"yaw": "0 0 1", "pitch": "0 1 0", "ball": "1 0 0"})
    assert built(tmp_path, text, "ball").nv == 3
    locked = (("to_pitch", math.pi / 2),)
    message = refusal(tmp_path, text, "ball", rest_pose=locked)
    assert "joint 'to_yaw'" in message and "in the default pose" in message


def test_four_hinges_of_a_ball_joint(tmp_path: Path) -> None:
    """Regular nowhere, because three hinges already give every rotation."""
    axes = {"a": "0 0 1", "b": "0 1 0", "c": "1 0 0", "ball": "0.3 0.5 0.8"}
    message = refusal(tmp_path, chain(axes), "ball")
    assert "which joint 'to_a' moves" in message
    assert "default pose" not in message


POINT = """<link name="bob"><inertial><origin xyz="{} 0 0"/><mass value="1"/>
  <inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link>"""


def test_point_masses(tmp_path: Path) -> None:
    pendulum = built(tmp_path, chain({"bob": "0 1 0"}, POINT.format(0.5)), "bob")
    assert reference.mass_matrix(pendulum, pendulum.rest_q)[0, 0] == 0.25
    message = refusal(tmp_path, chain({"bob": "0 1 0"}, POINT.format(0)), "bob")
    assert "link 'bob' and all that hangs on it, which joint 'to_bob' moves" in message
    message = refusal(tmp_path, robot_text(POINT.format(0)), "bob")
    assert "the floating root link 'bob'" in message


def nearly_singular(small: float) -> str:
    tiny = f"""<link name="ring"><inertial><mass value="1"/><inertia ixx="{small}"
      iyy="{small}" izz="{small}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
    return chain({"ring": "0 0 1", "ball": "0 0 1"}).replace(
        '<link name="ring"/>', tiny
    )


def test_nearly_singular_inertia(tmp_path: Path, x64: None) -> None:
    """What single precision loses is refused; double precision may keep it."""
    assert built(tmp_path, nearly_singular(1e-3), "ball").nv == 2
    message = refusal(tmp_path, nearly_singular(1e-7), "ball")
    assert "or dtype='float64'" in message and "joint 'to_ring'" in message
    robot = row(write(tmp_path, nearly_singular(1e-7)), "ball")
    assert build_system(robot, "float64").nv == 2
    assert "float64" not in refusal(tmp_path, nearly_singular(1e-16), "ball")


empty = np.zeros((1, 0))


def skew_chain(mass: float) -> str:
    """Two hinges about the same skew axis far from the origin, a light link between."""
    moments = f'ixx="{mass}" iyy="{mass}" izz="{mass}" ixy="0" ixz="0" iyz="0"'
    light = f'<inertial><mass value="{mass}"/><inertia {moments}/></inertial>'
    axis = '<axis xyz="0.3 -0.5 1"/>'
    far = '<origin xyz="0.7 0.2 -0.4" rpy="0.3 1 -0.7"/>'
    return robot_text(
        '<link name="world"/>',
        f'<link name="ring">{light}</link>',
        heavy("ball", 1.3, "0.3 0.2 0.1", "0.1 0.2 0.15"),
        joint("a", "continuous", "world", "ring", axis + far),
        joint("b", "continuous", "ring", "ball", axis),
    )


@pytest.mark.slow
def test_what_loads_is_right_in_single_precision(tmp_path: Path, x64: None) -> None:
    """Where the bound lets a robot pass, a step is right to 2 %."""
    worst = 0.0
    for mass in (1e-3, 3e-4, 1e-4):
        path = write(tmp_path, skew_chain(mass))
        robot = row(path, "ball", substeps=1, dt=0.005)
        single, double = (build_system(robot, f"float{n}") for n in (32, 64))
        runs = [(rollout(x), x.dtype) for x in (single, double)]
        for seed in range(8):
            rng = np.random.default_rng(seed)
            q, v = rng.uniform(-3, 3, 2), rng.normal(size=2)
            near, exact = (
                np.asarray(run(*(jnp.asarray(x, kind) for x in (q, v, empty))).v)[0] - v
                for run, kind in runs
            )
            worst = max(worst, np.abs(near - exact).max() / np.abs(exact).max())
    report("change of velocity of a nearly singular robot", worst)
    assert worst < 0.02
    assert "joint 'a'" in refusal(tmp_path, skew_chain(3e-5), "ball")


@pytest.mark.parametrize("name", ROBOTS)
def test_robots_of_the_suite_are_far_from_singular(name: str) -> None:
    system = load_system(ROBOTS[name])
    share = min(pivot.share for pivot in inertia.pivots(system, system.rest_q))
    report(f"pivot of {name}", share)
    assert share > 1e-3


def test_pivots_factor_the_mass_matrix(tmp_path: Path) -> None:
    """Their product is its determinant, in any pose."""
    axes = {"a": "0 0 1", "b": "0.2 1 0", "c": "1 0 0.3"}
    text = chain(axes, heavy("c", 1.5, "-0.1 0.4 0.2", "0.1 0.5 0.45"))
    for name in ("a", "b"):
        inside = heavy(name, 2.0, "0.3 0.1 -0.2", "0.6 0.2 0.7")
        text = text.replace(f'<link name="{name}"/>', inside)
    system = built(tmp_path, text, "c")
    q = np.array([0.7, -1.2, 0.4])
    product = np.prod([pivot.left for pivot in inertia.pivots(system, q)])
    determinant = np.linalg.det(reference.mass_matrix(system, q))
    assert product == pytest.approx(determinant, rel=1e-9)


def test_a_rotor_is_an_inertia() -> None:
    system = load_system(ROBOTS["hopper"])
    heavy = dataclasses.replace(system, armature=system.armature + 1.0)
    one, more = (inertia.pivots(s, s.rest_q)[-1].left for s in (system, heavy))
    assert more == pytest.approx(one + 1.0)


def test_inertia_that_is_lost_far_from_the_origin(tmp_path: Path) -> None:
    """A rotor of 1e-8 kg m^2 at the end of a boom of 10 m."""
    rotor = POINT.format(0).replace('="0"', '="1e-8"', 3)
    far = '<axis xyz="0 0 1"/><origin xyz="{} 0 0"/>'
    text = robot_text(
        link("boom"), rotor, joint("spin", "continuous", "boom", "bob", far)
    )
    assert built(tmp_path, text.format(0.0), "boom").nv == 7
    assert "joint 'spin'" in refusal(tmp_path, text.format(10.0), "boom")


ZEROS = """<inertial><mass value="0"/><inertia ixx="0" iyy="0" izz="0" ixy="0"
  ixz="0" iyz="0"/></inertial>"""


def test_a_massless_link_may_be_written_with_zeros(tmp_path: Path) -> None:
    zeros = chain({"yaw": "0 0 1", "ball": "1 0 0"})
    zeros = zeros.replace('"yaw"/>', f'"yaw">{ZEROS}</link>', 1)
    assert ZEROS in zeros
    assert built(tmp_path, zeros, "ball").mass.tolist() == [0.0, 1.0]
