"""URDF files as people have them are read as ROS, MuJoCo and Newton read them."""

from __future__ import annotations

import math
import re
import warnings
from pathlib import Path

import mujoco
import newton
import numpy as np
import pytest
from urdf_text import (
    built,
    heavy,
    joint,
    link,
    refusal,
    robot_text,
    row,
    sphere,
    write,
)

from newton_qd.physics import reference
from newton_qd.physics.model import (
    RobotDescriptionError,
    RobotDescriptionWarning,
    build,
    build_system,
    newton_builder,
)
from newton_qd.physics.model.verify import ModelMismatchError
from newton_qd.physics.solver import NewtonQDSolver
from newton_qd.physics.system import JointKind
from newton_qd.robots import Contact

# Links on fixed joints.


# A trunk with a head on its back, a lamp on the head, and an arm on the lamp.
MERGED = robot_text(
    heavy("trunk", 3.0, "0.1 0.0 -0.05", "0.04 0.05 0.06"),
    heavy("head", 1.5, "0.02 0.03 0.04", "0.01 0.015 0.02", sphere(0.1, "0 0 0.2")),
    heavy("lamp", 0.25, "-0.3 0.1 0.0", "0.005 0.004 0.006"),
    heavy("arm", 0.8, "0.0 0.2 0.1", "0.01 0.02 0.02", sphere(0.05)),
    joint(
        "neck", "fixed", "trunk", "head", '<origin xyz="0.3 0.1 0.2" rpy="1 0.5 -2"/>'
    ),
    joint("screw", "fixed", "head", "lamp", '<origin xyz="0 0 0.4" rpy="0.3 0 1"/>'),
    joint("elbow", "continuous", "lamp", "arm", '<axis xyz="0 1 0"/>'),
)
MERGED_ROW = {
    "feet": ("head",),
    "contacts": (Contact("head"), Contact("arm")),
    "pairs": ((Contact("head"), Contact("arm")),),
}


def test_fixed_links_bring_their_mass(tmp_path: Path) -> None:
    """MuJoCo merges links in the same way."""
    system = built(tmp_path, MERGED, "trunk", **MERGED_ROW)
    assert system.body_names == ("trunk", "arm")
    assert (system.torso, system.feet.tolist()) == (0, [0])
    # MuJoCo fixes the root of a file to the world, so here it hangs on a hinge.
    held = '<link name="world"/>' + joint("hold", "continuous", "world", "trunk")
    model = mujoco.MjModel.from_xml_string(
        MERGED.replace("</robot>", held + "</robot>")
    )
    np.testing.assert_allclose(system.mass, model.body_mass[1:], rtol=1e-12)
    np.testing.assert_allclose(system.com, model.body_ipos[1:], atol=1e-12)
    for body, (quaternion, moments) in enumerate(
        zip(model.body_iquat[1:], model.body_inertia[1:], strict=True)
    ):
        turn = reference.rotation_matrix(quaternion[[1, 2, 3, 0]])
        expected = turn @ np.diag(moments) @ turn.T
        np.testing.assert_allclose(system.inertia[body], expected, atol=1e-9)
    position = model.body_pos[2]
    np.testing.assert_allclose(system.parent_frame[1, :3], position, atol=1e-12)


def test_newton_gets_the_mass_of_fixed_links(tmp_path: Path) -> None:
    path = write(tmp_path, MERGED)
    system = build_system(row(path, "trunk"), "float32")
    model = newton_builder(path, True, 9.81).finalize()
    np.testing.assert_allclose(model.body_mass.numpy(), system.mass, rtol=1e-6)
    np.testing.assert_allclose(model.body_com.numpy(), system.com, atol=1e-6)
    inertia = model.body_inertia.numpy()
    np.testing.assert_allclose(inertia, system.inertia, atol=1e-6)
    inverse = np.linalg.inv(system.inertia)
    np.testing.assert_allclose(model.body_inv_inertia.numpy(), inverse, rtol=2e-4)


@pytest.mark.parametrize(
    ("values", "what"),
    [("body_mass", "mass"), ("body_com", "centre of mass"), ("body_inertia", "inert")],
)
def test_merged_masses_are_checked(
    values: str, what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    builder = build.newton_builder

    def misbuild(*arguments: object) -> newton.ModelBuilder:
        made = builder(*arguments)  # type: ignore[arg-type]
        getattr(made, values)[0] = getattr(made, values)[0] * 1.0001
        return made

    monkeypatch.setattr(build, "newton_builder", misbuild)
    with pytest.raises(ModelMismatchError, match=f"{what}.* of link 'trunk'"):
        built(tmp_path, MERGED, "trunk")


def test_a_massless_link_carries_a_fixed_one(tmp_path: Path) -> None:
    text = robot_text(
        '<link name="base"/>',
        heavy("box", 2.0, "0.1 0 0", "0.04 0.05 0.06"),
        joint("weld", "fixed", "base", "box", '<origin xyz="0 0 0.5" rpy="0 0 1"/>'),
    )
    system = built(tmp_path, text, "base")
    assert system.body_names == ("base",) and system.mass.tolist() == [2.0]
    expected = [0.1 * math.cos(1), 0.1 * math.sin(1), 0.5]
    np.testing.assert_allclose(system.com[0], expected, atol=1e-12)


# Sensors of many robots: a gram whose moments no body has.
SENSOR = """<link name="imu"><inertial><mass value="0.001"/><inertia ixx="1e-6"
 iyy="1e-6" izz="1e-6" ixy="1e-6" ixz="1e-6" iyz="1e-6"/></inertial></link>"""


def test_only_the_whole_body_must_be_real(tmp_path: Path) -> None:
    weld = joint("weld", "fixed", "trunk", "imu")
    system = built(tmp_path, robot_text(link("trunk"), SENSOR, weld), "trunk")
    assert system.mass[0] == pytest.approx(1.001)
    hinge = joint("hinge", "continuous", "trunk", "imu")
    with pytest.raises(
        RobotDescriptionError, match=r"<inertia>: principal moments: got .*, 3e-06;"
    ):
        built(tmp_path, robot_text(link("trunk"), SENSOR, hinge), "trunk")


def test_what_a_fixed_joint_says_of_motion_has_no_meaning(tmp_path: Path) -> None:
    still = """<axis xyz="0 0 0"/><limit lower="1" upper="-1"/>
      <dynamics friction="1" damping="-1"/>"""
    weld = joint("weld", "fixed", "a", "b", still)
    assert built(tmp_path, robot_text(link("a"), link("b"), weld), "b").nb == 1


# Capsules.


@pytest.mark.parametrize("sizes", ['length="0.4"', 'height="0.4"'])
def test_length_and_height_of_a_capsule_are_its_straight_part(
    sizes: str, tmp_path: Path
) -> None:
    capsule = f"""<collision><geometry><capsule radius="0.1" {sizes}/></geometry>
      </collision>"""
    text = robot_text(link("a", capsule))
    contacts = (Contact("a", 1), Contact("a", -1))
    system = built(tmp_path, text, "a", contacts=contacts)
    np.testing.assert_allclose(system.contact_position[:, 2], [0.2, -0.2])
    if "length" in sizes:
        hinge = joint("j", "continuous", "world", "a")
        held = robot_text('<link name="world"/>', link("a", capsule), hinge)
        size = mujoco.MjModel.from_xml_string(held).geom_size[0]
        assert size.tolist() == [0.1, 0.2, 0.0]


# Limits.

LIMITS = {"absent": "", "without bounds": '<limit effort="9" velocity="9"/>'}


@pytest.mark.parametrize("limit", LIMITS)
def test_missing_bounds_of_a_revolute_joint_are_noticed(
    limit: str, tmp_path: Path
) -> None:
    hinge = joint("hinge", "revolute", "a", "b", LIMITS[limit])
    text = robot_text(link("a"), link("b"), hinge)
    with pytest.warns(
        RobotDescriptionWarning,
        match=r"robot.urdf: limits of revolute joint\(s\) hinge: got none, .*contin",
    ):
        system = built(tmp_path, text, "a")
    assert (system.limit_lower[6], system.limit_upper[6]) == (-math.inf, math.inf)
    assert not system.limit_stiffness.any()


@pytest.mark.parametrize("kind", ["continuous", "prismatic"])
@pytest.mark.parametrize("limit", LIMITS)
def test_other_joints_need_no_bounds(kind: str, limit: str, tmp_path: Path) -> None:
    """URDF has no other way to say that a slide has no end."""
    text = robot_text(link("a"), link("b"), joint("j", kind, "a", "b", LIMITS[limit]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        system = built(tmp_path, text, "a")
    assert (system.limit_lower[6], system.limit_upper[6]) == (-math.inf, math.inf)


# Misspelt names.

SLIPS = {
    '<dynamics dampng="0.5"/>': "<dynamics>: attribute: got dampng, .*: damping, fric",
    '<dynamics dmpng="0.5"/>': "<dynamics>: attribute: got dmpng, .*: damping, fric",
    '<orgin xyz="1 0 0"/>': "<orgin>: element: got <orgin>, .*: <origin>, <parent>",
    '<AXIS xyz="0 0 1"/>': "<AXIS>: element: got <AXIS>, .*: .*<axis>",
    '<origin xzy="1 0 0"/>': "<origin>: attribute: got xzy, .*allowed: xyz, rpy",
    '<origin quat="1 0 0 0"/>': "<origin>: attribute: got quat, .*allowed: xyz, rpy",
    '<origin euler="0 0 90"/>': "<origin>: attribute: got euler, .*allowed: xyz, rpy",
}


@pytest.mark.parametrize("slip", SLIPS)
def test_misspelt_names_are_noticed(slip: str, tmp_path: Path) -> None:
    hinge = joint("hinge", "continuous", "a", "b", slip)
    text = robot_text(link("a"), link("b"), hinge)
    with pytest.warns(RobotDescriptionWarning, match=SLIPS[slip]):
        built(tmp_path, text, "a")


def test_names_of_simulators_are_not(tmp_path: Path) -> None:
    inside = '<gazebo/><dynamics viscous_damping="1" spring_stiffness="1"/>'
    inside += '<limit command_effort="1" gear_velocity="2" max_velocity="3"/>'
    other = "<collision_checking/><contact><lateral_friction/></contact>"
    hinge = joint("hinge", "continuous", "a", "b", inside)
    text = robot_text(link("a", other), link("b"), hinge)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        built(tmp_path, text, "a")


# Fixed bases.

ARM = robot_text(
    link("base", sphere(0.2), mass=5.0),
    link("plate"),
    link("arm", sphere(0.1, "0.5 0 0")),
    joint("weld", "fixed", "base", "plate", '<origin xyz="0 0 1"/>'),
    joint("hinge", "continuous", "plate", "arm", '<axis xyz="0 1 0"/>'),
)


def test_a_base_is_fixed_by_an_option(tmp_path: Path) -> None:
    floating = built(tmp_path, ARM, "base")
    assert (floating.nv, floating.body_names) == (7, ("base", "arm"))
    fixed = built(tmp_path, ARM, "arm", fixed_base=True)
    assert (fixed.nv, fixed.body_names) == (1, ("arm",))
    assert fixed.joint_kind.tolist() == [JointKind.REVOLUTE]
    assert fixed.total_mass == 1.0
    assert fixed.parent_frame[0, :3].tolist() == [0.0, 0.0, 1.0]
    assert fixed.scene_links == ("base", "plate")


def test_a_body_of_a_world_may_float(tmp_path: Path) -> None:
    """A joint of the type floating from the world makes what a floating root is."""
    root = built(tmp_path, ARM, "base")
    hung = ARM.replace("</robot>", '<link name="world"/>')
    hung += joint("free", "floating", "world", "base") + "</robot>"
    system = built(tmp_path, hung, "base")
    for field in ("joint_kind", "parent", "q_start", "v_start", "mass", "rest_q"):
        np.testing.assert_array_equal(getattr(system, field), getattr(root, field))
    assert (system.body_names, system.joint_names) == (root.body_names, ("", "hinge"))
    moved = hung.replace(
        'child link="base"/>', 'child link="base"/><origin xyz="1 0 0"/>'
    )
    with pytest.raises(
        RobotDescriptionError, match=r"'free' of .* floating, origin: g"
    ):
        built(tmp_path, moved, "base")


def test_a_world_may_float(tmp_path: Path) -> None:
    text = ARM.replace('"base"', '"world"')
    with pytest.raises(RobotDescriptionError, match="neither on a robot's world link"):
        built(tmp_path, text, "arm")
    assert built(tmp_path, text, "world", fixed_base=False).nv == 7


def test_fixed_links_are_named_in_errors(tmp_path: Path) -> None:
    message = "torso: got 'base', which is not a moving link in .*; allowed: arm$"
    with pytest.raises(RobotDescriptionError, match=message):
        built(tmp_path, ARM, "base", fixed_base=True)
    with pytest.raises(
        RobotDescriptionError, match="fixed_base: got 'yes'; allowed: None, True, False"
    ):
        built(tmp_path, ARM, "base", fixed_base="yes")


def test_the_solver_takes_a_fixed_base(tmp_path: Path) -> None:
    path = write(tmp_path, ARM)
    robot = row(path, "arm", fixed_base=True)
    model = newton_builder(path, False, robot.gravity).finalize()
    assert NewtonQDSolver(model, robot).model is model  # it compares both


# Files that a URDF file names.


ADDRESS = "http://localhost:9/a.obj"


def drawn(tag: str, filename: str) -> str:
    return f'<{tag}><geometry><mesh filename="{filename}"/></geometry></{tag}>'


def test_nothing_is_downloaded(tmp_path: Path, no_network: None) -> None:
    texture = f"<material name='m'><texture filename='{ADDRESS}'/></material>"
    text = robot_text(texture, link("a", drawn("visual", ADDRESS)))
    assert built(tmp_path, text, "a").nb == 1
    with pytest.warns(RobotDescriptionWarning, match=f"filename: got {ADDRESS}; allow"):
        newton_builder(write(tmp_path, text), True, 9.81)
    solid = robot_text(link("a", drawn("collision", ADDRESS)))
    message = refusal(tmp_path, solid, "a")
    assert re.search(
        "line 3, <mesh>: link 'a' has a mesh as collider, .*no file", message
    )


def test_a_visual_may_have_no_size(tmp_path: Path) -> None:
    """Sensors are often drawn as a box of size 0; a collider must have a size."""
    box = "<{0}><geometry><box size='0 0 0'/></geometry></{0}>"
    assert built(tmp_path, robot_text(link("a", box.format("visual"))), "a").nb == 1
    message = refusal(tmp_path, robot_text(link("a", box.format("collision"))), "a")
    assert "<box>: size: got '0 0 0'; allowed: positive numbers" in message


def test_meshes_of_a_package(tmp_path: Path) -> None:
    """The folder of the package contains the URDF file, as in every ROS package."""
    folder = tmp_path / "a_description" / "urdf"
    folder.mkdir(parents=True)
    (tmp_path / "a_description" / "a.stl").touch()
    for name in ("package://a_description/a.stl", "../a.stl"):
        text = robot_text(link("a", drawn("collision", name)))
        assert built(folder, text, "a").nb == 1
    with pytest.raises(RobotDescriptionError, match="no file on this machine"):
        built(folder, text.replace("../a", "package://b_description/a"), "a")
    # a folder inside may have the name of the package, too
    inside = folder / "a_description"
    inside.mkdir()
    assert built(inside, text.replace("../a", "package://a_description/a"), "a").nb == 1


TWICE = {
    "axis": joint("hinge", "continuous", "a", "b", '<axis xyz="0 1 0"/>' * 2),
    "limit": joint("hinge", "continuous", "a", "b", '<limit effort="1"/>' * 2),
    "child": joint("hinge", "continuous", "a", "b", '<child link="b"/>'),
}


@pytest.mark.parametrize("tag", TWICE)
def test_an_element_is_given_once(tag: str, tmp_path: Path) -> None:
    text = robot_text(link("a"), link("b"), TWICE[tag])
    assert f"second <{tag}> of this joint" in refusal(tmp_path, text, "a")


def test_a_template_is_refused(tmp_path: Path) -> None:
    """Its legs would be missing."""
    leg = "<xacro:leg prefix='left'/>"
    for text in (robot_text(link("a"), leg), robot_text(link("a", leg))):
        assert "got <xacro:leg>; allowed: URDF; run xacro" in refusal(
            tmp_path, text, "a"
        )


def test_prefixed_elements_are_left_out(tmp_path: Path) -> None:
    """Extensions of simulators do not need their namespace."""
    twice = "<link><collision><origin/><origin/></collision></link>"
    extension = f"<x:sensor y:on='1'/><gazebo><x:plugin/>{twice}</gazebo>"
    text = robot_text(link("a", extension), extension)
    assert built(tmp_path, text, "a").nb == 1
    own = text.replace("<robot ", "<robot xmlns='http://www.ros.org' ")
    assert own != text and built(tmp_path, own, "a").nb == 1


def test_an_axis_that_newton_cannot_normalize(tmp_path: Path) -> None:
    """In single precision, the square of its length is 0."""
    joint = (
        "<joint name='j' type='continuous'><parent link='a'/><child link='b'/>"
        "<axis xyz='{}'/></joint>"
    )
    parts = link("a"), link("b")
    text = robot_text(*parts, joint.format("0 1e-30 0"))
    with pytest.raises(RobotDescriptionError, match="got '0 1e-30 0'; allowed: a dir"):
        built(tmp_path, text, "a")
    assert built(tmp_path, robot_text(*parts, joint.format("0 1e-3 0")), "a").nb == 2
