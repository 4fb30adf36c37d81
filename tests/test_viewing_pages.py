"""Pages in a browser: no network, no errors, and the poses that the physics has."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from browser import Pages, chrome, pages, until

import newton_qd
from newton_qd import physics
from newton_qd.envs.base import PhysicsEnv
from newton_qd.physics import reference
from newton_qd.physics.model import build_system
from newton_qd.physics.system import PhysicsState, System
from newton_qd.robots import ROBOTS, Contact, RobotSpec
from newton_qd.scenes import SCENES
from newton_qd.viewing import Trajectory, drawing_of, record, show, write_replay
from newton_qd.viewing.drawing import drawing_of_system
from newton_qd.viewing.html import drawing_data

__all__ = ["chrome", "pages"]  # fixtures
pytestmark = pytest.mark.browser

HOSTILE = "</script><script>window.hacked=1</script><img src=x onerror=hacked=1>"
RIGHT_TO_LEFT = "\u202egnp.exe"
FIELD = np.deg2rad(40.0)  # vertical field of view of view.js


@pytest.fixture(scope="module")
def walk() -> Trajectory:
    env = newton_qd.create("ant_uni", episode_length=6, auto_reset=False)
    actions = jnp.linspace(-1, 1, 2 * 6 * 8, dtype=jnp.float32).reshape(2, 6, 8)
    return record(env, actions, jax.random.key(0), contacts=True)


@pytest.mark.slow
def test_replay_page(walk: Trajectory, pages: Pages, tmp_path: Path) -> None:
    page = pages.open(write_replay(walk, tmp_path / "walk.html"))
    assert page.inner_text("h1") == "ant"
    assert "world 2" in page.inner_text("#facts")
    time = "NQD.player.time"
    page.keyboard.press(" ")
    paused = page.evaluate(time)
    page.wait_for_timeout(100)
    assert page.evaluate(time) == paused
    page.keyboard.press("Home")
    assert page.evaluate(time) == 0
    page.keyboard.press("ArrowRight")
    assert page.evaluate(time) == pytest.approx(walk.dt)
    page.keyboard.press("End")
    assert page.evaluate(time) == pytest.approx(6 * walk.dt)
    box = page.locator(".charts").bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + 30)
    assert page.evaluate(time) == pytest.approx(3 * walk.dt, abs=walk.dt / 20)
    page.locator(".scrub").fill("0.1")
    assert page.evaluate(time) == pytest.approx(0.1)
    page.keyboard.press("s")
    apart = page.evaluate("NQD.player.view.shift[1]")
    assert apart < -2
    for box in ("impulses", "colliders", "trail", "link frames"):
        page.get_by_label(box, exact=True).click()
    assert page.evaluate("NQD.player.view.arrows.visible")
    before = page.evaluate("document.documentElement.dataset.theme")
    page.click("#theme")
    assert page.evaluate("document.documentElement.dataset.theme") != before
    page.click(".play")
    until(page, "NQD.player.time > 0.12")


@pytest.mark.slow
def test_the_choice_of_a_world_can_be_read_in_a_narrow_page(
    walk: Trajectory, pages: Pages, tmp_path: Path
) -> None:
    target = write_replay(walk, tmp_path / "walk.html", "hopper, random actions")
    page = pages.open(target, width=320, height=500)
    shown = page.locator("#facts select").bounding_box()
    assert shown is not None and shown["width"] > 180


@pytest.mark.slow
def test_kinematics_are_those_of_the_physics(
    walk: Trajectory, pages: Pages, tmp_path: Path
) -> None:
    page = pages.open(write_replay(walk, tmp_path / "walk.html"))
    code = """([drawing, q]) => {
        const tree = NQD.tree(drawing), out = new Float64Array(7 * tree.size);
        return Array.from(NQD.kinematics(tree, q, 0, out));
    }"""
    for name, robot in ROBOTS.items():
        system = build_system(robot, "float32")
        rng = np.random.default_rng(3)
        q = np.asarray(system.rest_q + rng.uniform(-1, 1, system.nq), np.float32)
        if system.joint_kind[0] == 0:
            q[3:7] /= np.linalg.norm(q[3:7])
        found = page.evaluate(
            code, [drawing_data(drawing_of_system(system)), q.tolist()]
        )
        seen = physics.forward_kinematics(system, jnp.asarray(q), jnp.zeros(system.nv))
        frames = np.asarray(found).reshape(-1, 7)
        assert np.allclose(frames[:, :3], seen.position, atol=1e-4), name
        sign = np.sign((frames[:, 3:] * seen.rotation).sum(axis=1, keepdims=True))
        assert np.allclose(frames[:, 3:] * sign, seen.rotation, atol=1e-4), name


class Hostile(PhysicsEnv):
    """A robot whose every name is hostile."""

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        del before, action
        return after.q[0], jnp.zeros((), bool), {}


def test_hostile_names_cannot_run(pages: Pages, tmp_path: Path) -> None:
    def escaped(text: str) -> str:
        for mark, name in (("&", "amp"), ("<", "lt"), (">", "gt"), ('"', "quot")):
            text = text.replace(mark, f"&{name};")
        return text

    links = [escaped(f"{HOSTILE} {index} {RIGHT_TO_LEFT}") for index in range(2)]
    inertial = """<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1"
        ixy="0" ixz="0" iyz="0"/></inertial>"""
    ball = '<geometry><sphere radius="0.1"/></geometry>'
    urdf = tmp_path / "hostile.urdf"
    urdf.write_text(
        f"""<robot name="{escaped(HOSTILE)}">
        <link name="{links[0]}">{inertial}<collision>{ball}</collision></link>
        <link name="{links[1]}">{inertial}<collision>{ball}</collision></link>
        <joint name="{escaped(HOSTILE)}" type="continuous">
          <parent link="{links[0]}"/><child link="{links[1]}"/>
          <origin xyz="0 0 0.3"/><axis xyz="0 1 0"/></joint></robot>""",
        encoding="utf-8",
    )
    names = [f"{HOSTILE} {index} {RIGHT_TO_LEFT}" for index in range(2)]
    robot = RobotSpec(
        name=f"{HOSTILE}{RIGHT_TO_LEFT}\"'",
        urdf=str(urdf),
        torso=names[0],
        feet=(names[1],),
        contacts=tuple(Contact(name) for name in names),
        actuators=((HOSTILE, 1.0),),
        rest_height=0.5,
    )
    found = record(Hostile(robot), jnp.zeros((4, 1)), jax.random.key(0), worlds=2)
    found = dataclasses.replace(found, labels=(HOSTILE, RIGHT_TO_LEFT))
    page = pages.open(write_replay(found, tmp_path / "hostile.html"))
    assert page.evaluate("window.hacked === undefined")
    assert page.text_content("h1") == robot.name
    assert page.locator("img").count() == 0
    assert HOSTILE in page.text_content("#facts")
    assert names[1] in page.text_content(".charts")
    # a mark that turns the direction of text ends with the name that has it
    styles = "e => getComputedStyle(e).unicodeBidi"
    for each in ("h1", ".key"):
        assert page.locator(each).first.evaluate(styles) == "isolate"


def still(system: System, name: str) -> Trajectory:
    """Trajectory of a robot in its default pose."""
    return Trajectory(
        drawing=drawing_of_system(system),
        q=np.tile(system.rest_q, (1, 2, 1)).astype(np.float32),
        lengths=np.ones(1, int),
        dt=0.05,
        rewards=np.zeros((1, 1)),
        descriptors=np.zeros((1, 2, 0)),
        descriptor_names=(),
        feet=np.zeros((1, 2, len(system.robot.feet))),
        labels=(name,),
    )


def projected(page: Any, points: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) of points (n, 3) in the picture of the page's camera."""
    code = "NQD.player.view.{}.toArray()"
    eye = np.array(page.evaluate(code.format("camera.position")))
    aim = np.array(page.evaluate(code.format("controls.target")))
    size = page.evaluate(
        "[NQD.player.stage.clientWidth, NQD.player.stage.clientHeight]"
    )
    back = (eye - aim) / np.linalg.norm(eye - aim)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    seen = (points - eye) @ np.stack([right, np.cross(back, right), back]).T
    scale = size[1] / 2 / np.tan(FIELD / 2)
    x = size[0] / 2 + scale * seen[:, 0] / -seen[:, 2]
    y = size[1] / 2 - scale * seen[:, 1] / -seen[:, 2]
    return np.stack([x, y], axis=1)


def marked(page: Any) -> np.ndarray:
    """Pixels (n, 2) of the picture that have the colour of link origins."""
    from matplotlib import pyplot

    shot = page.locator(".stage").screenshot()
    image = np.asarray(pyplot.imread(io.BytesIO(shot)))[..., :3]
    found = (image[..., 0] > 0.9) & (image[..., 1] < 0.15) & (image[..., 2] > 0.9)
    return np.argwhere(found)[:, ::-1] + 0.5


@pytest.mark.slow
def test_origins_of_links_are_where_the_physics_has_them(
    pages: Pages, tmp_path: Path
) -> None:
    """Every robot alone, and the ant in every scene that is not for other links."""
    shown = [(name, robot, None) for name, robot in ROBOTS.items()]
    scenes = [scene for scene in SCENES.values() if scene.links is None]
    shown += [(scene.name, ROBOTS["ant"], scene) for scene in scenes]
    for name, robot, scene in shown:
        system = build_system(robot, "float32", scene)
        path = write_replay(still(system, name), tmp_path / f"{name}.html")
        page = pages.open(path, width=240, height=320)
        page.keyboard.press(" ")
        page.keyboard.press("Home")
        page.keyboard.press("o")
        page.wait_for_timeout(80)
        points = reference.body_frames(system, system.rest_q)[:, :3]
        expected, found = projected(page, points), marked(page)
        inside = ((expected > 4) & (expected < [236, 1000])).all(axis=1)
        assert len(found) and inside.any(), name
        for pixel in expected[inside]:
            near = found[np.abs(found - pixel).max(axis=1) < 5]
            # the mark has 7 x 7 pixels; where two overlap, its middle is not known
            assert len(near), (name, pixel)
            if len(near) == 49:
                assert np.abs(near.mean(axis=0) - pixel).max() < 2, (name, pixel)
        page.close()


@pytest.mark.slow
def test_scripts_are_fast(pages: Pages, tmp_path: Path) -> None:
    """JavaScript of a frame: 4 ms for an ant, 8 ms for 50."""
    env = newton_qd.create("ant_uni", episode_length=40, auto_reset=False)
    actions = jax.random.uniform(jax.random.key(1), (50, 40, 8), minval=-1, maxval=1)
    many = record(env, actions, jax.random.key(0))
    for found, limit in ((many.world(0), 4.0), (many, 8.0)):
        path = write_replay(found, tmp_path / "fast.html")
        page = pages.open(path, width=320, height=400)
        code = """() => {
            const player = NQD.player, times = [];
            for (let k = 0; k < 60; k++) {
                const began = performance.now();
                player.time = (k % 40) * player.dt * 0.9;
                player.show();
                times.push(performance.now() - began);
            }
            return times.sort((a, b) => a - b)[30];
        }"""
        assert page.evaluate(code) < limit
        page.close()


def test_the_maze_of_the_point_has_a_page(pages: Pages, tmp_path: Path) -> None:
    env = newton_qd.create("pointmaze", episode_length=5, auto_reset=False)
    found = record(env, jnp.ones((5, 2)), jax.random.key(0))
    page = pages.open(write_replay(found, tmp_path / "maze.html"))
    page.keyboard.press(" ")
    page.keyboard.press("End")
    place = page.evaluate("Array.from(NQD.player.view.frames.slice(7, 10))")
    assert np.allclose(place[:2], found.q[0, -1], atol=1e-6)
    assert "steps" in page.inner_text(".clock")
    assert drawing_of(env).name in page.inner_text("h1")


@pytest.mark.slow
def test_a_notebook_shows_the_page(
    walk: Trajectory, pages: Pages, tmp_path: Path
) -> None:
    path = tmp_path / "notebook.html"
    shown = show(walk.world(0), height=300)._repr_html_()
    path.write_text(f"<!doctype html><p>out:</p>{shown}", encoding="utf-8")
    page = pages.context.new_page()
    page.on("pageerror", lambda error: pages.errors.append(str(error)))
    page.goto(path.absolute().as_uri())
    (frame,) = page.main_frame.child_frames
    until(frame, "typeof NQD === 'object' && NQD.player && NQD.player.cost > 0")
    assert frame.inner_text("h1") == "ant"


@pytest.mark.slow
def test_meshes_are_drawn(pages: Pages, tmp_path: Path) -> None:
    """A tetrahedron of an OBJ file, as the visual of a ball."""
    (tmp_path / "corner.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    urdf = tmp_path / "mesh.urdf"
    urdf.write_text(
        """<robot name="mesh"><link name="world"/><link name="ball">
        <inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0"
          iyz="0"/></inertial>
        <visual><origin xyz="0 0 1"/>
          <geometry><mesh filename="corner.obj" scale="1 2 3"/></geometry></visual>
        <collision><geometry><sphere radius="0.1"/></geometry></collision></link>
        <joint name="turn" type="continuous"><parent link="world"/><child link="ball"/>
          <axis xyz="0 0 1"/></joint></robot>""",
        encoding="utf-8",
    )
    robot = RobotSpec("mesh", str(urdf), "ball", actuators=(("turn", 1.0),))
    found = record(Hostile(robot), jnp.zeros((2, 1)), jax.random.key(0))
    (mesh,) = [s for s in found.drawing.shapes if s.kind == "mesh"]
    assert (mesh.vertices * mesh.size).max(axis=0).tolist() == [1, 2, 3]
    page = pages.open(write_replay(found, tmp_path / "mesh.html"))
    drawn = "NQD.player.view.shapes[0].mesh.geometry.attributes.position.array"
    assert max(page.evaluate(f"Array.from({drawn})")) == 3
