"""Scenes are the walls of the specification, and nothing else is accepted.

tests/test_mazes.py has the scenes of boxes.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from newton import ShapeFlags
from urdf_text import joint, link, row, sphere, write

from newton_qd.assets import AssetNotFoundError, find_urdf
from newton_qd.physics import reference
from newton_qd.physics.model import build_system, load_system, newton_builder
from newton_qd.physics.model.elements import Shape
from newton_qd.physics.model.scene import read_scene, whole_collider
from newton_qd.physics.model.xml_reader import (
    RobotDescriptionError,
    RobotDescriptionWarning,
)
from newton_qd.physics.system import ObstacleKind, System
from newton_qd.robots import ANT, Contact
from newton_qd.scenes import HUMANOID_TRAP, MAZE, SCENES, TRAP, Scene

RADIUS, HEIGHT = 0.5, 0.5  # of every wall, and of its axis over the ground [m]
# Ends (x, y) of the axis of every wall [m].
WALLS = {
    "trap": [
        ((12, -2), (12, 2)),
        ((7, 3), (12, 3)),
        ((7, -3), (12, -3)),
    ],
    "humanoid_trap": [
        ((9, -2), (9, 2)),
        ((4, 3), (9, 3)),
        ((4, -3), (9, -3)),
    ],
    "maze": [
        ((-5, -5), (40, -5)),
        ((-5, 40), (40, 40)),
        ((-5, -4), (-5, 39)),
        ((40, -4), (40, 39)),
        ((20, -4), (20, 19)),
        ((11, 7.5), (19, 7.5)),
        ((10, 20.75), (10, 39.25)),
    ],
}
LINKS = {"trap": ("trap",), "humanoid_trap": ("trap",), "maze": ("maze", "target")}
LEG_HALF = 0.282843  # half length of the axis of an ant's foot [m]


def wall_ends(system: System) -> np.ndarray:
    """Ends (walls, 2, 3) of the axes of the capsules of a scene."""
    ends = []
    for frame, size in zip(
        system.obstacle_frame[1:], system.obstacle_size[1:], strict=True
    ):
        half = size[1] * reference.rotation_matrix(frame[3:])[:, 2]
        ends.append([frame[:3] - half, frame[:3] + half])
    return np.array(ends)


def test_a_turned_capsule_keeps_its_axis() -> None:
    turn = reference.rpy_quaternion(0, np.pi / 2, np.pi / 2)  # z to x, then to y
    frame = np.concatenate([[1, 2, 3], turn])
    shape = Shape("leg", "capsule", frame, np.array([0.1, 0.4, 0]))
    row = whole_collider(5, 2, shape)
    np.testing.assert_allclose(row.segment, [0, 0.4, 0], atol=1e-12)
    np.testing.assert_array_equal(row.position, [1, 2, 3])
    assert (row.body, row.obstacle, row.radius) == (5, 2, 0.1)


@pytest.mark.parametrize("name", WALLS)
def test_walls(name: str) -> None:
    system = load_system(ANT, scene=SCENES[name])
    expected = np.full((len(WALLS[name]), 2, 3), HEIGHT)
    expected[..., :2] = WALLS[name]
    np.testing.assert_allclose(wall_ends(system), expected, atol=1e-6)
    kinds = [ObstacleKind.PLANE] + [ObstacleKind.CAPSULE] * len(expected)
    assert system.obstacle_kind.tolist() == kinds
    assert system.obstacle_size[1:, 0].tolist() == [RADIUS] * len(expected)


def test_links_of_the_scenes() -> None:
    for name, links in LINKS.items():
        system = load_system(ANT, scene=SCENES[name])
        assert system.scene_links == links
        identity = [0, 0, 0, 0, 0, 0, 1]
        assert system.scene_frames[0].tolist() == identity
    target = load_system(ANT, scene=MAZE).scene_frames[1]
    assert target.tolist() == [35, 0, 0.5, 0, 0, 0, 1]
    plain = load_system(ANT)
    assert plain.scene is None and plain.scene_links == ()
    assert plain.scene_frames.shape == (0, 7)


@pytest.mark.parametrize("name", WALLS)
def test_newton_reads_the_same_walls(name: str) -> None:
    """Viewers and other solvers load the file itself."""
    system = load_system(ANT, scene=SCENES[name])
    path = find_urdf(SCENES[name].urdf)
    model = newton_builder(str(path), False, 9.81).finalize()
    flags = model.shape_flags.numpy()
    solid = (flags & int(ShapeFlags.COLLIDE_SHAPES)) != 0
    assert solid.sum() == len(WALLS[name])
    assert np.all(model.shape_body.numpy()[solid] == -1)
    ends = []
    for frame, size in zip(
        model.shape_transform.numpy()[solid],
        model.shape_scale.numpy()[solid],
        strict=True,
    ):
        axis = reference.rotation_matrix(frame[3:].astype(np.float64))[:, 2]
        half = float(size[1]) * axis
        ends.append([frame[:3] - half, frame[:3] + half])
        assert size[0] == RADIUS
    np.testing.assert_allclose(ends, wall_ends(system), atol=1e-5)


@pytest.mark.parametrize("name", SCENES)
def test_colliders_are_drawn(name: str) -> None:
    shapes = re.findall(
        r"<(visual|collision)>.*?<origin ([^/]*)/>\s*<geometry>(.*?)</geometry>",
        find_urdf(SCENES[name].urdf).read_text(encoding="utf-8"),
        re.DOTALL,
    )
    drawn = {shape[1:] for shape in shapes if shape[0] == "visual"}
    solid = {shape[1:] for shape in shapes if shape[0] == "collision"}
    targets = {shape for shape in drawn if "sphere" in shape[1]}
    assert solid == drawn - targets
    assert len(targets) == ("maze" in name)


@pytest.mark.parametrize("name", WALLS)
def test_collision_pairs_of_the_ant(name: str) -> None:
    """Torso and feet against every wall, with the whole capsule; no upper leg."""
    system, plain = load_system(ANT, scene=SCENES[name]), load_system(ANT)
    pairs = list(zip(system.contact_body, system.contact_obstacle, strict=True))
    bodies = (0, 2, 4, 6, 8)
    walls = range(len(WALLS[name]) + 1)
    assert pairs == [(body, wall) for body in bodies for wall in walls]
    ground = system.ground_contacts
    for field in ("body", "position", "segment", "radius"):
        expected = getattr(plain, f"contact_{field}")
        np.testing.assert_array_equal(
            getattr(system, f"contact_{field}")[ground], expected
        )
    for body in bodies:
        rows = (system.contact_body == body) & (system.contact_obstacle > 0)
        assert np.all(system.contact_radius[rows] == (0.08 if body else 0.25))
        halves = np.linalg.norm(system.contact_segment[rows], axis=1)
        np.testing.assert_allclose(halves, LEG_HALF if body else 0.0, atol=1e-6)
        centre = system.com[body]
        np.testing.assert_allclose(
            system.contact_position[rows] - centre, 0, atol=1e-12
        )
    np.testing.assert_array_equal(system.rest_q, plain.rest_q)
    assert reference.lowest_contact(system, system.rest_q) == pytest.approx(
        0, abs=1e-12
    )


def test_links_that_collide() -> None:
    scene = dataclasses.replace(TRAP, links=("aux_2",))
    system = load_system(ANT, scene=scene)
    walls = system.contact_obstacle > 0
    assert system.contact_body[walls].tolist() == [3] * 3
    assert np.all(np.diff(system.contact_body) >= 0)


def test_every_collider_of_a_link_collides(tmp_path: Path) -> None:
    """As the humanoid's shins, which have two each."""
    capsule = """<collision><geometry><capsule radius="0.1" height="1.0"/></geometry>
    </collision>"""
    text = f"<robot name='two'>{link('leg', capsule + sphere(0.2, '0 0 -1'))}</robot>"
    robot = row(
        write(tmp_path, text), "leg", contacts=(Contact("leg"), Contact("leg", 1))
    )
    system = build_system(robot, "float32", HUMANOID_TRAP)
    walls = np.flatnonzero(system.contact_obstacle)
    assert len(walls) == 2 * 3
    assert system.contact_radius[walls].tolist() == [0.1] * 3 + [0.2] * 3
    expected = [[0, 0, 0.5]] * 3 + [[0, 0, 0]] * 3
    np.testing.assert_allclose(system.contact_segment[walls], expected, atol=1e-15)


def test_scene_of_a_sphere(tmp_path: Path) -> None:
    stone = '<collision><geometry><sphere radius="0.3"/></geometry></collision>'
    text = f"<robot name='stones'><link name='stone'>{stone}</link></robot>"
    scene = Scene("stones", write(tmp_path, text))
    system = load_system(ANT, scene=scene)
    assert system.scene_links == ("stone",)
    assert system.obstacle_kind.tolist() == [ObstacleKind.PLANE, ObstacleKind.CAPSULE]
    assert system.obstacle_size[1].tolist() == [0.3, 0, 0]


def test_fixed_joints_place_a_link(tmp_path: Path) -> None:
    stone = sphere(0.3, "0 0 1")
    turned = '<origin xyz="1 2 0" rpy="1.5707963267948966 0 0"/>'
    text = f"""<robot name="placed"><link name="world"/>
    <link name="a"/><link name="b">{stone}</link>
    {joint("one", "fixed", "world", "a", turned)}
    {joint("two", "fixed", "a", "b", '<origin xyz="0 0 3"/>')}</robot>"""
    links = read_scene(Scene("placed", write(tmp_path, text)))
    assert [found.name for found in links] == ["a", "b"]
    np.testing.assert_allclose(links[1].frame[:3], [1, -1, 0], atol=1e-12)
    np.testing.assert_allclose(links[1].shapes[0].frame[:3], [1, -2, 0], atol=1e-12)


def test_systems_with_scenes_are_cached() -> None:
    assert load_system(ANT, scene=TRAP) is load_system(ANT, "float32", TRAP)
    assert load_system(ANT, scene=dataclasses.replace(TRAP)) is load_system(
        ANT, scene=TRAP
    )
    assert load_system(ANT, scene=TRAP) is not load_system(ANT, scene=MAZE)
    assert load_system(ANT, scene=None) is load_system(ANT)


MESH = '<collision><geometry><mesh filename="a.obj"/></geometry></collision>'


@pytest.mark.parametrize(
    ("inside", "message"),
    [
        ("", "element <link> is missing"),
        (
            link("a", sphere(0.1)),
            "<link name='a'>: mass: got one; allowed: none in a scene",
        ),
        (
            f"<link name='a'>{MESH}</link>",
            "<link name='a'>: collider: got mesh; allowed: sphere, capsule, box",
        ),
        (
            f"<link name='world'>{sphere(0.1)}</link>",
            "<link name='world'>: collider: got one; allowed: none in a scene",
        ),
        (
            f"<link name='a'/><link name='b'/>{joint('j', 'continuous', 'a', 'b')}",
            "joint 'j': got 'continuous'; allowed: fixed joints in a scene",
        ),
        ("<link name='a'/><link name='b'/>", "links: got 2 without a parent"),
    ],
)
def test_refused_files(tmp_path: Path, inside: str, message: str) -> None:
    path = write(tmp_path, f"<robot name='scene'>{inside}</robot>")
    with pytest.raises(RobotDescriptionError, match=re.escape(message)):
        load_system(ANT, scene=Scene("scene", path))


def test_misspelt_names_are_noticed(tmp_path: Path) -> None:
    wall = '<orgin xyz="5 0 0"/><geometry><sphere radius="1"/></geometry>'
    file = tmp_path / "walls.urdf"
    link = f'<link name="wall"><collision>{wall}</collision></link>'
    file.write_text(f'<robot name="walls">{link}</robot>')
    with pytest.warns(RobotDescriptionWarning, match=r"<orgin>: element: got <orgin>"):
        read_scene(Scene("walls", str(file)))


def test_refused_rows(tmp_path: Path) -> None:
    with pytest.raises(AssetNotFoundError, match=r"'lab.urdf'.*maze.urdf"):
        load_system(ANT, scene=Scene("lab", "lab.urdf"))
    message = "scene 'trap', links: got 'foot_5', .* in ant.urdf; allowed: torso, aux_1"
    with pytest.raises(RobotDescriptionError, match=message):
        load_system(ANT, scene=dataclasses.replace(TRAP, links=("foot_5",)))
    bare = row(write(tmp_path, f"<robot name='r'>{link('base')}</robot>"), "base")
    message = "colliders of 'base': got none; allowed: at least one, each of sphere"
    with pytest.raises(RobotDescriptionError, match=message):
        load_system(bare, scene=dataclasses.replace(TRAP, links=("base",)))
    wrong: Any
    for wrong in (["torso"], "torso", (3,)):
        message = r"scene 'trap', links: got .*; allowed: None, a tuple of names"
        with pytest.raises(RobotDescriptionError, match=message):
            load_system(ANT, scene=dataclasses.replace(TRAP, links=wrong))
    twice = dataclasses.replace(TRAP, links=("aux_1", "aux_1"))
    with pytest.raises(RobotDescriptionError, match=r"links: got .*allowed: each once"):
        load_system(ANT, scene=twice)
    wrong = 4
    with pytest.raises(RobotDescriptionError, match=r"'trap', urdf: got 4; allowed: a"):
        load_system(ANT, scene=dataclasses.replace(TRAP, urdf=wrong))
    wrong = ["foot_1"]
    message = r"robot 'ant', contacts: link: got \['foot_1'\]; allowed: a name"
    with pytest.raises(RobotDescriptionError, match=message):
        load_system(dataclasses.replace(ANT, contacts=(Contact(wrong),)))
    with pytest.raises(TypeError, match="scene: got 'trap'; allowed: None, or a Scene"):
        load_system(ANT, scene="trap")  # pyright: ignore[reportArgumentType]


def test_contact_tables_of_different_lengths_are_refused() -> None:
    system = load_system(ANT, scene=TRAP)
    message = "contact_segment: got 1 rows; allowed: 20, as many as contact_body has"
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(system, contact_segment=np.zeros((1, 3)))


def test_a_scene_without_walls_touches_nothing(tmp_path: Path) -> None:
    path = write(tmp_path, '<robot name="s"><link name="target"/></robot>')
    with pytest.warns(RobotDescriptionWarning, match="no link has a collider"):
        system = build_system(ANT, "float32", Scene("s", path))
    assert len(system.obstacle_kind) == 1 and not system.contact_obstacle.any()
