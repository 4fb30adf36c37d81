"""A URDF file or a row that physics cannot run is refused, saying what and where."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path

import pytest
from urdf_text import (
    built,
    joint,
    link,
    refusal,
    robot_text,
    row,
    sphere,
    write,
)

from newton_qd.assets import AssetNotFoundError, find_urdf
from newton_qd.physics.model import RobotDescriptionError, build_system, load_system
from newton_qd.physics.model.xml_reader import XmlReader
from newton_qd.robots import ANT, Contact, RobotSpec

ANT_TEXT = find_urdf("ant.urdf").read_text(encoding="utf-8")
FEET = ("foot_1", "foot_2", "foot_3", "foot_4")


def edited(folder: Path, old: str, new: str) -> RobotSpec:
    """The ant with the first occurrence of a text in its file replaced."""
    assert old in ANT_TEXT
    return dataclasses.replace(ANT, urdf=write(folder, ANT_TEXT.replace(old, new, 1)))


BAD_FILES = {
    "not XML": ("</robot>", "</robt>", r"line \d+, in <robot>: malformed XML: mism"),
    "cut off": ("</robot>", "", r"in <robot>: malformed XML: no element found"),
    "not a robot": (
        ANT_TEXT[ANT_TEXT.index("<robot") :],
        "<sdf/>",
        r"<sdf>: outermost element: got <sdf>; allowed: <robot>",
    ),
    "NaN": (
        'value="10.0"',
        'value="nan"',
        r"line 18, <mass>: value: got 'nan'; allowed",
    ),
    "text": ('xyz="0.2 0.2 0.0"', 'xyz="0.2 a 0.0"', r"<origin>: xyz: got '0.2 a 0.0'"),
    "short": ('xyz="0.2 0.2 0.0"', 'xyz="0.2 0.0"', r"allowed: 3 finite"),
    "negative mass": (
        'value="10.0"',
        'value="-1"',
        r"<mass>: value: got '-1'; allowed: pos",
    ),
    "zero mass": ('value="10.0"', 'value="0"', r"<mass>: value: got '0'; allowed: pos"),
    "two masses": (
        "</inertial>",
        "</inertial><inertial/>",
        r"<inertial>: second <inertial> of this link",
    ),
    "underscore": (
        '<mass value="10.0"/>',
        '<mass value="1_0"/>',
        r"got '1_0'; allowed",
    ),
    "no mass": ('<mass value="10.0"/>', "", r"<inertial>: element <mass> is missing"),
    "no moment": ('iyy="1.0"', "", r"<inertia>: attribute 'iyy' is missing"),
    "inertia": (
        'izz="1.0"',
        'izz="3.0"',
        r"<inertia>: principal moments: got 1, 1, 3;",
    ),
    "no radius": ('radius="0.25"', "", r"<sphere>: attribute 'radius' is missing"),
    "no height": (
        'height="0.28284272" length="0.28284272"',
        "",
        r"line \d+, <capsule>: attribute 'length' is missing",
    ),
    "two lengths": (
        'length="0.28284272"',
        'length="0.4"',
        r"height, length: got .*equal",
    ),
    "shape": (
        '<sphere radius="0.25"/>',
        "<cone/>",
        r"<geometry>: shape: got cone; allow",
    ),
    "joint type": (
        'type="revolute"',
        'type="planar"',
        r"line 32, <joint name='hip_1'>: type: got 'planar'; allowed: rev",
    ),
    "floating in a robot": (
        'type="revolute"',
        'type="floating"',
        r"joint 'hip_1' of the type floating, origin: got frame in a link that moves",
    ),
    "no link": (
        '<child link="aux_1"/>',
        '<child link="x"/>',
        r"child: got 'x'; allowed: .*foot_1",
    ),
    "second parent": (
        '<child link="aux_2"/>',
        '<child link="foot_1"/>',
        r"link 'foot_1' already has a parent",
    ),
    "two trees": (
        "</robot>",
        link("stray") + "</robot>",
        r"links: got 2 without a parent \(torso, stray\)",
    ),
    "loop": (
        "</robot>",
        link("a")
        + link("b")
        + joint("u", "revolute", "a", "b")
        + joint("w", "revolute", "b", "a")
        + "</robot>",
        r"links: got a loop \(a, b\); allowed: one tree",
    ),
    "same name": (
        'name="hip_2"',
        'name="hip_1"',
        r"<joint name='hip_1'>: second joint",
    ),
    "axis": (
        '<axis xyz="0.0 0.0 1.0"/>',
        '<axis xyz="0 0 0"/>',
        r"<axis>: xyz: got '0 0 0'",
    ),
    "limits": (
        'upper="0.5',
        'upper="-1.5',
        r"<limit>: lower: got -0.523599; allowed: .*upper",
    ),
    "continuous joint with limits": (
        'type="revolute"',
        'type="continuous"',
        r"<limit>: lower: got '-0.52.*'; allowed: none for a continuous joint, so rem",
    ),
    "half a limit": (
        'lower="-0.5235987755982988"',
        "",
        r"<limit>: .*'lower' is missing",
    ),
    "damping": (
        'damping="20.0"',
        'damping="-1"',
        r"<dynamics>: damping: got -1; allowed",
    ),
    "friction": (
        'damping="20.0"',
        'friction="1"',
        r"friction: got 1.*joint friction is not",
    ),
    "mimic": (
        "<dynamics",
        '<mimic joint="hip_2"/><dynamics',
        r"<mimic> is not supported; make",
    ),
    "massless leaf": (
        "</robot>",
        '<link name="tip"/>' + joint("t", "revolute", "torso", "tip") + "</robot>",
        r"mass of link 'tip' and all that hangs on it: got none",
    ),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_file(case: str, tmp_path: Path) -> None:
    old, new, message = BAD_FILES[case]
    robot = edited(tmp_path, old, new)
    with pytest.raises(RobotDescriptionError, match=message) as caught:
        build_system(robot, "float32")
    assert robot.urdf in str(caught.value)


def test_continuous_joint_may_say_how_strong_it_is(tmp_path: Path) -> None:
    limits = ('effort="1" velocity="2"', 'lower="-1e16" upper="1e16"')
    for limit in limits:
        hinge = joint("j", "continuous", "a", "b", f"<limit {limit}/>")
        path = write(tmp_path, f"<robot name='r'>{link('a')}{link('b')}{hinge}</robot>")
        system = build_system(row(path, "a"), "float32")
        assert system.limit_lower[-1] == -math.inf
        assert system.limit_upper[-1] == math.inf


@pytest.mark.filterwarnings("ignore:Asset file")
def test_mesh_that_is_not_there(tmp_path: Path) -> None:
    mesh = '<collision><geometry><mesh filename="a.obj"/></geometry></collision>'
    path = write(tmp_path, f"<robot name='r'>{link('a', mesh)}</robot>")
    message = r"link 'a' has a mesh as collider, .*allowed: sphere or capsule, or box"
    with pytest.raises(RobotDescriptionError, match=message):
        build_system(row(path, "a"), "float32")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1, outside any element: malformed XML: no element found"),
        ('<?xml version="1.0" encoding="x"?><robot/>', "unknown encoding: x"),
        ("<robot/>", "line 1, <robot>: element <link> is missing"),
        ("<robot><link/></robot>", "line 1, <link>: attribute 'name' is missing"),
        ('<robot><link name="world"/></robot>', "<robot>: nothing in it moves"),
    ],
)
def test_file_without_a_robot(text: str, message: str, tmp_path: Path) -> None:
    path = write(tmp_path, text)
    with pytest.raises(RobotDescriptionError, match=message):
        build_system(row(path, "torso"), "float32")


def test_entities_do_not_grow(tmp_path: Path) -> None:
    """Ten bytes that stand for ten thousand million."""
    tens = (f'<!ENTITY e{n + 1} "{f"&e{n};" * 10}">' for n in range(9))
    entities = f'<!DOCTYPE robot [<!ENTITY e0 "0123456789">{"".join(tens)}]>'
    path = write(tmp_path, f'{entities}<robot><link name="&e9;"/></robot>')
    with pytest.raises(RobotDescriptionError, match="malformed XML: limit on input"):
        build_system(row(path, "torso"), "float32")


def test_entities_read_no_file(tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text("found", encoding="utf-8")
    entity = f'<!DOCTYPE robot [<!ENTITY e SYSTEM "{secret.as_uri()}">]>'
    path = write(tmp_path, f"{entity}<robot>&e;</robot>")
    assert not XmlReader(Path(path)).root.text


def changed(**changes: object) -> RobotSpec:
    return dataclasses.replace(ANT, **changes)


def soft(**changes: object) -> RobotSpec:
    return changed(material=dataclasses.replace(ANT.material, **changes))


LINKS = "allowed: torso, aux_1, foot_1, "
JOINTS = "allowed: hip_1, ankle_1, hip_2, "
NAN = math.nan
TWO_FEET = (Contact("foot_1"), Contact("foot_2"))
BAD_ROWS = {
    "torso": (changed(torso="chest"), f"torso: got 'chest', .* in ant.urdf; {LINKS}"),
    "contact": (
        changed(contacts=(Contact("x"),), feet=()),
        f"contacts: got 'x'.* {LINKS}",
    ),
    "contact of a foot": (
        changed(contacts=(Contact("foot_x", 1), *ANT.contacts[1:])),
        f"contacts: got 'foot_x'.* {LINKS}",
    ),
    "actuator": (changed(actuators=(("x", 1.0),)), f"actuators: got 'x'.* {JOINTS}"),
    "unnamed": (changed(actuators=(("", 1.0),)), f"actuators: got ''.* {JOINTS}"),
    "rest": (changed(rest_pose=(("x", 1.0),)), f"rest_pose: got 'x'.* {JOINTS}"),
    "foot": (
        changed(feet=("aux_1",)),
        "feet: got 'aux_1', .* no contact; allowed: foot_1",
    ),
    "twice": (changed(feet=FEET + FEET), "feet: got foot_1, .* twice"),
    "servo twice": (changed(servos=("hip_1", "hip_1")), "servos: got hip_1 twice"),
    "sphere end": (changed(contacts=(Contact("aux_1"),), feet=()), "needs a sphere"),
    "capsule end": (
        changed(contacts=(Contact("torso", 1),), feet=()),
        "end of 'torso': got 1, .* needs a capsule collider; the link has sphere",
    ),
    "collider": (
        changed(contacts=(Contact("foot_1", 1, "toe"),), feet=()),
        "needs a capsule collider named 'toe'; the link has capsule",
    ),
    "end": (changed(contacts=(Contact("foot_1", 2),), feet=()), "got 2; .* -1, 0, 1"),
    "rest in limits": (changed(rest_pose=()), "'ankle_1': got 0; allowed: 0.523"),
    "dt": (changed(dt=NAN), "dt: got nan; allowed: finite .*above 0"),
    "no dt": (changed(dt=0.0), "dt: got 0.0; allowed: finite .*above 0"),
    "gravity": (changed(gravity=-9.8), "gravity: got -9.8; allowed: finite .*from 0"),
    "one substep": (changed(substeps=True), "substeps: got True; allowed: .* from 1"),
    "file": (changed(urdf=3), "urdf: got 3; allowed: a path"),
    "pair twice": (changed(pairs=(TWO_FEET, TWO_FEET[::-1])), "pairs: got .* twice"),
    "substeps": (changed(substeps=0), "substeps: got 0; allowed: .* from 1"),
    "half substep": (changed(substeps=2.5), "substeps: got 2.5; allowed: .* from 1"),
    "gear": (changed(actuators=(("hip_1", NAN),)), "gear of 'hip_1': got nan; allowed"),
    "rest NaN": (
        changed(rest_pose=(("hip_1", NAN),)),
        "angle of 'hip_1': got nan; allowed",
    ),
    "height": (changed(rest_height=math.inf), "rest_height: got inf; allowed: finite"),
    "friction": (
        soft(friction=NAN),
        "material.friction: got nan; allowed: finite .*from 0",
    ),
    "gear of text": (
        changed(actuators=(("hip_1", "30"),)),
        "gear of 'hip_1': got '30'; allowed: finite .*above 0",
    ),
    "actuators without gears": (
        changed(actuators=("hip_1", "ankle_1")),
        r"actuators\[0\]: got 'hip_1'; allowed: a tuple of \(joint, gear\), such as",
    ),
    "list": (
        changed(actuators=[("hip_1", 1.0)]),
        r"actuators: got \[\('hip_1', 1.0\)\]; allowed: a tuple of \(joint",
    ),
    "one rest angle": (
        changed(rest_pose=("hip_1", 1.0)),
        r"rest_pose\[0\]: got 'hip_1'; allowed: a tuple of \(joint, angle\)",
    ),
    "contact by name": (
        changed(contacts=("torso",)),
        r"contacts\[0\]: got 'torso'; allowed: a tuple of Contact, such as",
    ),
    "pair by name": (
        changed(pairs=(("foot_1", "foot_2"),)),
        r"pairs\[0\]: got .*; allowed: a tuple of pairs of Contact",
    ),
    "one foot": (
        changed(feet="foot_1"),
        "feet: got 'foot_1'; allowed: a tuple of links",
    ),
    "one servo": (
        changed(servos="hip_1"),
        "servos: got 'hip_1'; allowed: a tuple of joint",
    ),
    "contact twice": (
        changed(contacts=(*ANT.contacts, ANT.contacts[-1])),
        "contacts: end of 'foot_4': got .* twice; allowed: each once",
    ),
    "two angles": (
        changed(rest_rotation=(0.0, 0.0)),
        r"rest_rotation: got \(0.0, 0.0\); allowed: a tuple of roll, pitch and yaw",
    ),
    "dt of text": (changed(dt="0.1"), "dt: got '0.1'; allowed: finite .*above 0"),
    "material": (changed(material=3), "material: got 3; allowed: a Material"),
    "support": (soft(support=0), "material.support: got 0; allowed: finite .*above 0"),
}


@pytest.mark.parametrize("case", BAD_ROWS)
def test_bad_row(case: str) -> None:
    robot, message = BAD_ROWS[case]
    with pytest.raises(RobotDescriptionError, match=f"robot 'ant', .*{message}"):
        build_system(robot, "float32")


def test_rows_that_cannot_be_hashed_are_named() -> None:
    with pytest.raises(
        RobotDescriptionError, match=r"feet: got \['foot_1'\]; allowed: a t"
    ):
        load_system(changed(feet=["foot_1"]))
    with pytest.raises(
        RobotDescriptionError, match=r"gear of 'hip_1': got \[1\]; allowed"
    ):
        load_system(changed(actuators=(("hip_1", [1]),)))
    with pytest.raises(
        TypeError, match="robot: got 'ant'; allowed: a RobotSpec, such as"
    ):
        load_system("ant")  # pyright: ignore[reportArgumentType]
    with pytest.raises(RobotDescriptionError, match="name: got None; allowed: text"):
        load_system(changed(name=None))


def test_rest_height_without_a_height(tmp_path: Path) -> None:
    text = f"""<robot name="fixed"><link name="world"/>{link("arm")}
    {joint("hinge", "continuous", "world", "arm")}</robot>"""
    path = write(tmp_path, text)
    assert build_system(row(path, "arm"), "float32").rest_q.tolist() == [0.0]
    with pytest.raises(RobotDescriptionError, match="no coordinate raises the torso"):
        build_system(row(path, "arm", rest_height=1.0), "float32")


def test_actuators_of_fixed_joints(tmp_path: Path) -> None:
    text = f"""<robot name="stiff">{link("body")}{link("arm")}<link name="hand"/>
    {joint("elbow", "continuous", "body", "arm")}
    {joint("wrist", "fixed", "arm", "hand")}</robot>"""
    robot = row(write(tmp_path, text), "body", actuators=(("wrist", 1.0),))
    with pytest.raises(
        RobotDescriptionError, match=r"got 'wrist', which is fixed; allowed: elbow$"
    ):
        build_system(robot, "float32")


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(AssetNotFoundError, match=r"'nt.urdf'.*allowed: .*ant.urdf"):
        load_system(changed(urdf="nt.urdf"))
    absent = tmp_path / "absent.urdf"
    with pytest.raises(FileNotFoundError, match=re.escape(str(absent))):
        load_system(changed(urdf=str(absent)))
    with pytest.raises(AssetNotFoundError):
        find_urdf(tmp_path)
    with pytest.raises(AssetNotFoundError):
        find_urdf("")


@pytest.mark.parametrize(("axis", "heights"), [(1, "0 to 0.5"), (-1, "-0.5 to 0")])
def test_a_height_beyond_the_limits_of_its_slide(
    axis: int, heights: str, tmp_path: Path
) -> None:
    limits = f'<axis xyz="0 0 {axis}"/><limit lower="0" upper="0.5"/>'
    text = robot_text(
        '<link name="world"/>',
        joint("z", "prismatic", "world", "body", limits),
        link("body", sphere(0.7)),
    )
    allowed = f"rest_height: got .*'z' must be at .*; allowed: .* torso of {heights} m"
    for changes in ({"rest_height": 3.0}, {"contacts": (Contact("body"),)}):
        with pytest.raises(RobotDescriptionError, match=allowed):
            built(tmp_path, text, "body", **changes)


def test_a_quaternion_in_an_origin(tmp_path: Path) -> None:
    turned = '<origin xyz="0 0 0" quat_xyzw="0 0 0 1"/><axis xyz="0 0 1"/>'
    text = robot_text(
        link("base"), joint("j", "continuous", "base", "tip", turned), link("tip")
    )
    assert 'rpy="roll pitch yaw"' in refusal(tmp_path, text, "base")


def test_a_pair_given_twice(tmp_path: Path) -> None:
    named = sphere(0.2).replace("<collision>", '<collision name="c">')
    text = robot_text(
        '<link name="world"/>',
        joint("first", "floating", "world", "a"),
        joint("second", "floating", "world", "b"),
        link("a", named),
        link("b", sphere(0.2)),
    )
    pairs = (
        (Contact("a"), Contact("b")),
        (Contact("b"), Contact("a", collider="c")),
    )
    with pytest.raises(RobotDescriptionError, match=r"pairs: got .* twice"):
        built(tmp_path, text, "a", pairs=pairs)
