"""A System is the URDF file and the robot's row, and nothing else is accepted."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable
from pathlib import Path

import newton
import numpy as np
import pytest
import warp as wp
from urdf_text import built, joint, link, robot_text, row, sphere, write

from newton_qd.assets import find_urdf
from newton_qd.physics import reference
from newton_qd.physics.model import build, build_system, load_system
from newton_qd.physics.model.description import read_description
from newton_qd.physics.model.rest import raising_coordinate
from newton_qd.physics.model.verify import ModelMismatchError
from newton_qd.physics.model.xml_reader import RobotDescriptionError
from newton_qd.physics.system import JointKind, ObstacleKind, System
from newton_qd.robots import ANT, ROBOTS, Contact, RobotSpec

ROOT_HALF = math.sqrt(0.5)

# Centre of mass and rotation (wxyz) of every body of the ant in the default pose.
DEFAULT_POSE = {
    "torso": ((0, 0, 0.51334), (1, 0, 0, 0)),
    "aux_1": ((0.3, 0.3, 0.51334), (1, 0, 0, 0)),
    "foot_1": ((0.528558, 0.528558, 0.29667), (0.906308, -0.298836, 0.298836, 0)),
    "aux_2": ((-0.3, 0.3, 0.51334), (1, 0, 0, 0)),
    "foot_2": ((-0.528558, 0.528558, 0.29667), (0.906308, -0.298836, -0.298836, 0)),
    "aux_3": ((-0.3, -0.3, 0.51334), (1, 0, 0, 0)),
    "foot_3": ((-0.528558, -0.528558, 0.29667), (0.906308, 0.298836, -0.298836, 0)),
    "aux_4": ((0.3, -0.3, 0.51334), (1, 0, 0, 0)),
    "foot_4": ((0.528558, -0.528558, 0.29667), (0.906308, 0.298836, 0.298836, 0)),
}
# Radius, end-to-end length and axis of the colliders of the ant.
LEG_AXES = {"1": (-1, -1, 0), "2": (1, -1, 0), "3": (1, 1, 0), "4": (-1, 1, 0)}
LENGTHS = {"aux": 0.44284272, "foot": 0.7256854}


@pytest.fixture(scope="module")
def ant() -> System:
    return load_system(ANT)


# What the ant is.


def test_default_pose_of_the_ant(ant: System) -> None:
    frames = reference.body_frames(ant, ant.rest_q)
    assert ant.body_names == tuple(DEFAULT_POSE)
    for frame, com, expected in zip(
        frames, ant.com, DEFAULT_POSE.values(), strict=True
    ):
        position = frame[:3] + reference.rotation_matrix(frame[3:]) @ com
        np.testing.assert_allclose(position, expected[0], atol=1e-5)
        np.testing.assert_allclose(frame[[6, 3, 4, 5]], expected[1], atol=1e-5)


def test_layout_of_the_ant(ant: System) -> None:
    joints = [f"{kind}_{leg}" for leg in "1234" for kind in ("hip", "ankle")]
    assert ant.joint_names == ("", *joints)
    assert (ant.nb, ant.nq, ant.nv, ant.nu) == (9, 15, 14, 8)
    assert ant.parent.tolist() == [-1, 0, 1, 0, 3, 0, 5, 0, 7]
    kinds = [JointKind.FREE] + [JointKind.REVOLUTE] * 8
    assert ant.joint_kind.tolist() == kinds
    assert ant.q_start.tolist() == [0, *range(7, 15)]
    assert ant.v_start.tolist() == [0, *range(6, 14)]
    assert ant.control_dof.tolist() == list(range(6, 14))
    assert ant.gear.tolist() == [350.0] * 8
    assert ant.feet.tolist() == [2, 4, 6, 8]
    assert ant.torso == 0


def test_numbers_of_the_ant(ant: System) -> None:
    assert ant.mass.tolist() == [10.0] + [1.0] * 8
    np.testing.assert_allclose(ant.inertia, np.tile(np.eye(3), (9, 1, 1)), atol=1e-15)
    assert ant.damping.tolist() == [0.0] * 6 + [20.0] * 8
    degrees = [(-30, 30), (30, 70), (-30, 30), (-70, -30)]
    degrees += [(-30, 30), (-70, -30), (-30, 30), (30, 70)]
    limits = np.stack([ant.limit_lower, ant.limit_upper], axis=1)
    np.testing.assert_allclose(limits[6:], np.radians(degrees), rtol=1e-14)
    assert np.array_equal(limits[:6], [(-np.inf, np.inf)] * 6)
    np.testing.assert_allclose(ant.limit_stiffness, [0.0] * 6 + [7000.0] * 8)
    assert ant.contact_stiffness == pytest.approx(18.0 * 9.8 / (4 * 0.003))
    assert not ant.armature.any() and not ant.stiffness.any()


@pytest.mark.parametrize("leg", LEG_AXES)
@pytest.mark.parametrize("part", LENGTHS)
def test_leg_colliders_of_the_ant(part: str, leg: str) -> None:
    body = read_description(find_urdf("ant.urdf")).bodies[f"{part}_{leg}"]
    (shape,) = body.shapes
    assert shape.kind == "capsule"
    length = LENGTHS[part]
    np.testing.assert_allclose(shape.size, [0.08, length / 2 - 0.08, 0], rtol=1e-12)
    axis = reference.rotation_matrix(shape.frame[3:])[:, 2]
    np.testing.assert_allclose(axis, np.array(LEG_AXES[leg]) * ROOT_HALF, atol=1e-14)
    np.testing.assert_allclose(shape.frame[:3], body.link.com, atol=1e-15)


def test_contacts_of_the_ant(ant: System) -> None:
    assert ant.contact_body.tolist() == [0, 2, 4, 6, 8]
    assert ant.contact_radius.tolist() == [0.25] + [0.08] * 4
    outer = 0.2 + (0.7256854 / 2 - 0.08) * ROOT_HALF
    expected = [(0, 0), (1, 1), (-1, 1), (-1, -1), (1, -1)]
    positions = np.zeros((5, 3))
    positions[:, :2] = np.array(expected) * outer
    np.testing.assert_allclose(ant.contact_position, positions, atol=1e-14)
    assert ant.contact_obstacle.tolist() == [0] * 5
    assert ant.obstacle_kind.tolist() == [ObstacleKind.PLANE]
    assert ant.obstacle_frame.tolist() == [[0, 0, 0, 0, 0, 0, 1]]


@pytest.mark.parametrize("name", ROBOTS)
def test_every_robot_rests_on_the_ground(name: str) -> None:
    system = load_system(ROBOTS[name])
    assert system.rest_q.shape == (system.nq,)
    assert np.isfinite(system.rest_q).all()
    if ROBOTS[name].rest_height is None and ROBOTS[name].contacts:
        assert reference.lowest_contact(system, system.rest_q) == pytest.approx(
            0.0, abs=1e-12
        )


@pytest.mark.parametrize("name", ROBOTS)
def test_colliders_are_drawn(name: str) -> None:
    """Viewers draw what collides: every collider is a visual too."""
    shapes = re.findall(
        r"<(visual|collision)[^>]*>.*?<origin ([^/]*)/>\s*<geometry>(.*?)</geometry>",
        find_urdf(ROBOTS[name].urdf).read_text(encoding="utf-8"),
        re.DOTALL,
    )
    drawn = [shape[1:] for shape in shapes if shape[0] == "visual"]
    assert drawn == [shape[1:] for shape in shapes if shape[0] == "collision"]
    assert drawn


def test_arrays_are_typed_and_read_only(ant: System) -> None:
    for field in dataclasses.fields(ant):
        value = getattr(ant, field.name)
        if isinstance(value, np.ndarray):
            assert value.dtype in (np.int32, np.float64), field.name
            with pytest.raises(ValueError, match="read-only"):
                value[...] = 0


# Newton's model, the file and the reference are one robot.


@pytest.mark.slow
@pytest.mark.usefixtures("newton_without_adjoints")
def test_reference_agrees_with_newton(ant: System) -> None:
    path = str(find_urdf("ant.urdf"))
    built = build.newton_builder(path, True, 9.8).finalize()
    rng = np.random.default_rng(0)
    for _ in range(5):
        q = rng.normal(size=ant.nq)
        q[3:7] /= np.linalg.norm(q[3:7])
        state = built.state()
        coordinates = wp.array(q, dtype=wp.float32, device=built.device)
        speeds = wp.zeros(ant.nv, dtype=wp.float32, device=built.device)
        newton.eval_fk(built, coordinates, speeds, state)
        frames = reference.body_frames(ant, q)
        assert state.body_q is not None
        theirs = state.body_q.numpy()
        np.testing.assert_allclose(frames[:, :3], theirs[:, :3], atol=3e-6)
        dots = np.sum(frames[:, 3:] * theirs[:, 3:], axis=1)
        np.testing.assert_allclose(np.abs(dots), 1.0, atol=1e-5)


def _scaled(name: str, row: int) -> Callable[[newton.ModelBuilder], None]:
    def change(builder: newton.ModelBuilder) -> None:
        values = getattr(builder, name)
        values[row] = values[row] * 1.00001

    return change


def _moved(name: str, row: int, by: object) -> Callable[[newton.ModelBuilder], None]:
    def change(builder: newton.ModelBuilder) -> None:
        values = getattr(builder, name)
        values[row] = values[row] + by

    return change


# Adding it turns a frame by 1e-4 rad about its x axis.
TURN = wp.transform(wp.vec3(), wp.quat(5e-5, 0.0, 0.0, 0.0))
MISBUILT = {
    "mass": (_scaled("body_mass", 2), "mass of link 'foot_1' is 1.0 "),
    "com": (
        _moved("body_com", 3, wp.vec3(1e-5, 0.0, 0.0)),
        "centre of mass of link 'aux_2'",
    ),
    "inertia": (_scaled("body_inertia", 4), "inertia of link 'foot_2'"),
    "frame": (_moved("joint_X_p", 3, TURN), "joint frame of link 'aux_2'"),
    "child frame": (
        _moved("joint_X_c", 3, TURN),
        "joint frame in the link of link 'aux_2'",
    ),
    "axis": (
        _moved("joint_axis", 7, wp.vec3(0.0, 0.0, 1e-4)),
        "axis of joint 'ankle_1'",
    ),
    "lower": (
        _moved("joint_limit_lower", 7, 1e-5),
        "lower limit of joint 'ankle_1' is 0.5235987755982988 ",
    ),
    "upper": (_moved("joint_limit_upper", 8, 1e-5), "upper limit of joint 'hip_2'"),
    "damping": (
        _scaled("joint_damping", 6),
        "damping of joint 'hip_1' is 20.0 in the file but 20.000",
    ),
    "collider": (
        _moved("shape_transform", 3, wp.transform(wp.vec3(1e-4), wp.quat())),
        "collider of link 'aux_1'",
    ),
}


@pytest.mark.parametrize("case", MISBUILT)
def test_misbuilt_model_is_refused(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    change, message = MISBUILT[case]
    builder = build.newton_builder

    def misbuild(*arguments: object) -> newton.ModelBuilder:
        built = builder(*arguments)  # type: ignore[arg-type]
        change(built)
        return built

    monkeypatch.setattr(build, "newton_builder", misbuild)
    with pytest.raises(ModelMismatchError, match=re.escape(message)):
        build_system(ANT, "float32")


def test_joint_without_a_kind_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    builder = build.newton_builder

    def misbuild(*arguments: object) -> newton.ModelBuilder:
        built = builder(*arguments)  # type: ignore[arg-type]
        built.joint_type[3] = newton.JointType.D6
        return built

    monkeypatch.setattr(build, "newton_builder", misbuild)
    message = "Newton's type of joint 'ant/hip_2': got D6; allowed: FREE, REVOLUTE"
    with pytest.raises(RobotDescriptionError, match=message):
        build_system(ANT, "float32")


# Other trees.

PLANAR = f"""<robot name="planar"><link name="world"/><link name="x_slide"/>
<link name="z_slide"/>
{link("body", sphere(0.1, "0 0 -0.2"))}{link("foot", sphere(0.05, "0 0 -0.5"))}
{joint("x", "prismatic", "world", "x_slide", '<axis xyz="1 0 0"/>')}
{joint("z", "prismatic", "x_slide", "z_slide", '<axis xyz="0 0 -1"/>')}
{joint("pitch", "continuous", "z_slide", "body", '<axis xyz="0 1 0"/>')}
{
    joint(
        "knee",
        "revolute",
        "body",
        "foot",
        '''<axis xyz="0 2 0"/>
<limit lower="-1" upper="0.5" effort="9" velocity="9"/>''',
    )
}</robot>"""


def planar_spec(folder: Path, **changes: object) -> RobotSpec:
    return row(
        write(folder, PLANAR),
        "body",
        feet=("foot",),
        contacts=(Contact("foot"), Contact("body")),
        actuators=(("knee", 30.0),),
        **changes,
    )


def test_planar_root(tmp_path: Path) -> None:
    system = build_system(planar_spec(tmp_path), "float32")
    assert system.body_names == ("x_slide", "z_slide", "body", "foot")
    assert system.joint_names == ("x", "z", "pitch", "knee")
    assert system.parent.tolist() == [-1, 0, 1, 2]
    slide, turn = JointKind.PRISMATIC, JointKind.REVOLUTE
    assert system.joint_kind.tolist() == [slide, slide, turn, turn]
    assert system.mass.tolist() == [0, 0, 1, 1]
    assert system.joint_axis[3].tolist() == [0, 1, 0]
    # Free joints have no limits; the knee's are as stiff as its gear.
    np.testing.assert_allclose(system.limit_stiffness, [0, 0, 0, 600])
    assert system.contact_body.tolist() == [2, 3]
    # The z axis points down, and the lower sphere ends 0.55 m below the origin.
    np.testing.assert_allclose(system.rest_q, [0, -0.55, 0, 0], atol=1e-15)


@pytest.mark.parametrize("limits", [(0.0, 0.5), (-1.0, 0.0)])
def test_a_limit_may_be_zero(limits: tuple[float, float], tmp_path: Path) -> None:
    lower, upper = limits
    text = PLANAR.replace('lower="-1" upper="0.5"', f'lower="{lower}" upper="{upper}"')
    system = build_system(row(write(tmp_path, text), "body"), "float32")
    assert (system.limit_lower[3], system.limit_upper[3]) == limits


def test_rest_height(tmp_path: Path) -> None:
    planar = build_system(planar_spec(tmp_path, rest_height=1.25), "float32")
    np.testing.assert_allclose(planar.rest_q, [0, -1.25, 0, 0], atol=1e-15)
    ant = build_system(dataclasses.replace(ANT, rest_height=0.75), "float32")
    assert ant.rest_q[2] == 0.75
    # a slide that begins above the ground, and points down
    raised = PLANAR.replace('<axis xyz="0 0 -1"/>', '<axis xyz="0 0 -1"/>{}')
    raised = raised.format('<origin xyz="0 0 2"/>')
    robot = dataclasses.replace(
        planar_spec(tmp_path, rest_height=1.25), urdf=write(tmp_path, raised)
    )
    np.testing.assert_allclose(build_system(robot, "float32").rest_q[1], 0.75)


def test_limits_of_joints_without_gear(tmp_path: Path) -> None:
    weaker = dataclasses.replace(ANT, actuators=(("hip_1", 50.0), ("ankle_2", 70.0)))
    stiffness = build_system(weaker, "float32").limit_stiffness
    np.testing.assert_allclose(stiffness[6:], [1000] + [1400] * 7)
    passive = dataclasses.replace(ANT, actuators=())
    stiffness = build_system(passive, "float32").limit_stiffness
    np.testing.assert_allclose(stiffness[6:], 2000)


def test_a_limit_on_one_side_is_stiff(tmp_path: Path) -> None:
    for lower, upper in ((-0.5, 1e9), (-1e9, 0.5), (-1e9, 1e9)):
        limit = f'<limit lower="{lower}" upper="{upper}"/>'
        hinge = joint("hinge", "revolute", "base", "tail", limit)
        robot = row(
            write(tmp_path, robot_text(link("base"), link("tail"), hinge)), "base"
        )
        stiffness = build_system(robot, "float32").limit_stiffness[6]
        assert stiffness == pytest.approx(2000 if min(-lower, upper) < 1 else 0)


def test_fixed_links_join_their_parent(tmp_path: Path) -> None:
    toe = f'<link name="toe">{sphere(0.02, "0 0 0.1")}</link>'
    turned = '<origin xyz="0.3 0 0" rpy="0 1.5707963267948966 0"/>'
    text = f"""<robot name="welded">{link("base")}{toe}{link("tail")}
    {joint("weld", "fixed", "base", "toe", turned)}
    {joint("hinge", "continuous", "toe", "tail", '<origin xyz="0 0 1"/>')}</robot>"""
    robot = row(
        write(tmp_path, text), "base", contacts=(Contact("toe"),), feet=("toe",)
    )
    system = build_system(robot, "float32")
    assert system.body_names == ("base", "tail")
    assert system.feet.tolist() == [0]
    np.testing.assert_allclose(system.contact_position, [[0.4, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(system.parent_frame[1, :3], [1.3, 0, 0], atol=1e-12)


TWO_CAPSULES = "".join(
    f"""<collision name="{name}"><origin xyz="0 0 {height}"/><geometry>
    <capsule radius="0.1" height="0.4"/></geometry></collision>"""
    for name, height in (("low", 0), ("high", 1))
)


def test_contacts_name_one_of_several_colliders(tmp_path: Path) -> None:
    path = write(tmp_path, f'<robot name="two">{link("base", TWO_CAPSULES)}</robot>')
    contacts = (Contact("base", 1, "high"), Contact("base", -1, "low"))
    system = build_system(row(path, "base", contacts=contacts), "float32")
    np.testing.assert_allclose(system.contact_position[:, 2], [1.2, -0.2])
    unclear = row(path, "base", contacts=(Contact("base", 1),))
    with pytest.raises(
        RobotDescriptionError,
        match=r"the link has capsule.*, capsule.*; .* are several",
    ):
        build_system(unclear, "float32")


def test_robot_without_joints(tmp_path: Path) -> None:
    path = write(tmp_path, f"<robot name='one'>{link('box', sphere(0.3))}</robot>")
    system = build_system(row(path, "box", contacts=(Contact("box"),)), "float32")
    assert (system.nb, system.nq, system.nv, system.nu) == (1, 7, 6, 0)
    assert system.rest_q.tolist() == pytest.approx([0, 0, 0.3, 0, 0, 0, 1])


def test_precision() -> None:
    with pytest.raises(
        ValueError, match="dtype: got 'float16'; allowed: float32, float64"
    ):
        load_system(ANT, "float16")
    with pytest.raises(ValueError, match="dtype: got 'float64' while JAX x64 is off"):
        load_system(ANT, "float64")


def test_systems_are_cached(x64: None) -> None:
    double = load_system(ANT, "float64")
    assert double.dtype == "float64"
    assert load_system(dataclasses.replace(ANT), "float64") is double
    assert load_system(ANT) is not double
    assert load_system(ANT) is load_system(ANT, "float32")


def test_an_edited_file_is_another_robot(tmp_path: Path) -> None:
    path = tmp_path / "ant.urdf"
    text = find_urdf(ANT.urdf).read_text(encoding="utf-8")
    path.write_text(text, encoding="utf-8")
    robot = dataclasses.replace(ANT, urdf=str(path))
    before = load_system(robot)
    assert load_system(robot) is before
    mass = re.search(r'<mass value="([^"]+)"/>', text)
    assert mass is not None
    path.write_text(text.replace(mass[0], '<mass value="9"/>'), encoding="utf-8")
    after = load_system(robot)
    assert 9.0 in after.mass and 9.0 not in before.mass


def test_the_root_is_raised_and_not_a_lift(tmp_path: Path) -> None:
    """The torso is on a vertical slide, and its base is free."""
    lift = '<origin xyz="0 0 0.5"/><axis xyz="0 0 1"/><limit lower="0" upper="0.1"/>'
    text = robot_text(
        link("base", sphere(0.2)),
        joint("lift", "prismatic", "base", "head", lift),
        link("head"),
    )
    system = built(tmp_path, text, "head", contacts=(Contact("base"),))
    assert np.asarray(system.rest_q)[[2, 7]].tolist() == [0.2, 0.0]
    assert raising_coordinate(system) == (2, 1.0)


def test_contacts_without_gravity_are_as_stiff_as_on_earth() -> None:
    system, material = (
        build_system(ROBOTS["pusher"], "float32"),
        ROBOTS["pusher"].material,
    )
    held = material.support * material.static_penetration
    assert system.contact_stiffness == pytest.approx(9.81 * system.total_mass / held)


def test_the_lying_humanoid_looks_up() -> None:
    turn = build_system(ROBOTS["humanoidstandup"], "float32").rest_q[3:7]
    ahead = reference.rotation_matrix(turn)[:, 0]
    np.testing.assert_allclose(ahead, [0, 0, 1], atol=1e-9)


def test_actions_of_the_quadruped_go_from_hip_to_knee() -> None:
    system = build_system(ROBOTS["quadruped"], "float32")
    bodies = np.searchsorted(system.v_start, system.control_dof[:4])
    names = [system.joint_names[body] for body in bodies]
    assert names == [f"{x}_front_left" for x in ("hip", "thigh", "knee")] + [
        "hip_front_right"
    ]
