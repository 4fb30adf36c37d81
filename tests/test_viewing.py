"""Trajectories, what is drawn of a robot, and the text of pages."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_runs import compile_once, point_task, reference

import newton_qd
from newton_qd import cli
from newton_qd.assets import find_urdf
from newton_qd.physics.model import build_system
from newton_qd.physics.reference import body_frames as reference_frames
from newton_qd.qd import load_run
from newton_qd.robots import ROBOTS
from newton_qd.scenes import SCENES
from newton_qd.viewing import (
    Recorder,
    camera,
    drawing_of,
    html,
    joined,
    record,
    record_elites,
    render,
    replay_html,
    write_explorer,
    write_replay,
)
from newton_qd.viewing.drawing import body_frames, composed, drawing_of_system
from newton_qd.viewing.sight import camera_offset
from newton_qd.viewing.trajectory import Trajectory
from newton_qd.viewing.video import _durations

__all__ = ["compile_once", "reference"]  # fixtures
PAGES = Path(newton_qd.__file__).parent / "viewing" / "pages"


@pytest.fixture(scope="module")
def ant() -> Any:
    return newton_qd.create("ant_uni", episode_length=5, auto_reset=False)


@pytest.fixture(scope="module")
def walk(ant: Any) -> Trajectory:
    actions = jnp.linspace(-1, 1, 2 * 6 * 8, dtype=jnp.float32).reshape(2, 6, 8)
    return record(ant, actions, jax.random.key(0), contacts=True)


def test_a_trajectory_is_that_of_the_steps(ant: Any, walk: Trajectory) -> None:
    actions = jnp.linspace(-1, 1, 2 * 6 * 8, dtype=jnp.float32).reshape(2, 6, 8)
    step = jax.jit(ant.step)
    for world, key in enumerate(jax.random.split(jax.random.key(0), 2)):
        state = jax.jit(ant.reset)(key)
        for k in range(6):
            assert np.allclose(walk.q[world, k], state.pipeline_state.q, atol=1e-5)
            state = step(state, actions[world, k])
            assert np.allclose(walk.rewards[world, k], state.reward, atol=1e-3)
            contact = state.info["state_descriptor"]
            assert np.array_equal(walk.descriptors[world, k + 1], contact)
            assert np.array_equal(walk.feet[world, k + 1], contact)
    # the episode has 5 steps, the plan 6
    assert walk.lengths.tolist() == [5, 5] and walk.steps == 6
    assert np.allclose(walk.returns, walk.rewards[:, :5].sum(axis=1))
    assert walk.descriptor_names[0] == "foot_1 contact" and walk.dt == ant.dt


def test_contacts_are_those_of_the_bodies(ant: Any, walk: Trajectory) -> None:
    assert walk.contacts is not None
    impulse = walk.contacts.impulse
    touching = impulse[..., 2] > 0
    assert touching.any() and walk.contacts.ground.all()
    feet = [ant.system.body_names.index(name) for name in walk.drawing.feet]
    carried = np.stack(
        [impulse[:, :, walk.contacts.body == foot, 2].sum(axis=2) for foot in feet], -1
    )
    threshold = 0.01 * ant.system.total_mass * 9.81 * ant.dt
    assert np.array_equal(carried > threshold, walk.feet[:, 1:] > 0)


def test_feet_of_a_replay_are_those_of_the_trajectory(walk: Trajectory) -> None:
    shown = html.trajectory_data(walk)["feet"]
    found = np.frombuffer(base64.b64decode(shown["data"]), np.uint8)
    assert 0 < found.sum() < found.size
    assert np.array_equal(found.reshape(shown["shape"]), walk.feet)


def test_a_policy_and_auto_reset() -> None:
    env = newton_qd.create("pointmaze", episode_length=4)
    up = record(env, lambda obs: jnp.ones_like(obs), jax.random.key(1), worlds=3)
    assert up.q.shape == (3, 5, 2) and up.labels == ("world 1", "world 2", "world 3")
    # the wrapper has returned to the first state where the last would be
    assert up.lengths.tolist() == [3, 3, 3]
    assert np.all(np.diff(up.q[:, :4], axis=1) > 0)
    whole = joined([up, record(env, jnp.zeros((2, 2)), jax.random.key(2))])
    assert whole.worlds == 4 and whole.select([3]).labels == ("world 1",)
    assert np.array_equal(whole.q[3, 2], whole.q[3, 4])


def test_a_state_of_ones_own_is_the_start() -> None:
    env = newton_qd.create("pointmaze", auto_reset=False, episode_length=4)
    state = env.step(env.reset(jax.random.key(1)), jnp.ones(2))
    seen = record(env, jnp.full((2, 3, 2), 0.5), state)
    later = env.rollout(state, jnp.full((3, 2), 0.5))
    for q in seen.q:
        np.testing.assert_array_equal(q, jnp.stack([state.obs, *later.obs]))
    plan = jnp.linspace(0, 1, 6).reshape(3, 2)
    long, short = (record(env, plan, jax.random.key(1), steps=n) for n in (3, 2))
    first = env.reset(jax.random.key(1)).obs
    np.testing.assert_allclose(long.q[0, 0], first, rtol=1e-6)
    np.testing.assert_allclose(short.q, long.q[:, :3], rtol=1e-6)
    batch = jax.tree.map(lambda x: x[None], state)
    with pytest.raises(ValueError, match=r"^key: got a state of a batch of shape \(1,"):
        record(env, jnp.zeros((3, 2)), batch)
    other = newton_qd.create("hopper", auto_reset=False).reset(jax.random.key(0))
    with pytest.raises(ValueError, match=r"^key: got obs of shape \(11,\)"):
        record(env, jnp.zeros((3, 2)), other)
    with pytest.raises(ValueError, match=r"^key: got obs of shape \(11,\)"):
        record(env, lambda seen: seen @ jnp.eye(2), other)
    wide = state.replace(obs=np.zeros(2, np.int32))
    with pytest.raises(TypeError, match=r"^key\.obs: got an array of .*int32; allowed"):
        record(env, jnp.zeros((3, 2)), wide)


def test_wrong_arguments_are_named(ant: Any, walk: Trajectory) -> None:
    key = jax.random.key(0)
    for wrong in (jnp.zeros((3, 7)), jnp.zeros(8), jnp.zeros((2, 0, 8))):
        with pytest.raises(ValueError, match=r"policy: got .*; allowed: a function"):
            record(ant, wrong, key)
    with pytest.raises(TypeError, match="policy: got 'walk'"):
        record(ant, "walk", key)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="worlds: got 0"):
        record(ant, jnp.zeros((3, 8)), key, worlds=0)
    with pytest.raises(ValueError, match=r"steps: got 4; allowed: None, .* 1 to 3"):
        record(ant, jnp.zeros((3, 8)), key, steps=4)
    with pytest.raises(ValueError, match=r"steps, worlds: got .*, which needs at leas"):
        record(ant, lambda obs: obs[:8], key, steps=2**31 - 1)
    with pytest.raises(TypeError, match="policy: got 3; allowed: a function of para"):
        Recorder(ant, 3, 5)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"steps: got 1.5; allowed: integers from 1"):
        Recorder(ant, lambda _, obs: obs[:8], 1.5)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="q: got coordinates that are not finite; all"):
        dataclasses.replace(walk, q=np.full_like(walk.q, np.nan))
    with pytest.raises(TypeError, match="trajectory: got 3; allowed: a Trajectory"):
        render(3, "a.png")  # type: ignore[arg-type]
    for runs in ("a", ["a"], walk):
        with pytest.raises(TypeError, match=r"runs.*: got .*; allowed: a list of one"):
            write_explorer(runs, "a.html")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="key: got 3; allowed: one key"):
        record(ant, jnp.zeros((3, 8)), 3)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="env: got str; allowed: environments"):
        record("ant", jnp.zeros((3, 8)), key)  # type: ignore[arg-type]
    batch = newton_qd.create("pointmaze", batch_size=2)
    with pytest.raises(ValueError, match="env: got an environment of 2 worlds"):
        record(batch, jnp.zeros((3, 2)), key)
    with pytest.raises(ValueError, match="trajectories: got none"):
        joined([])


@pytest.mark.parametrize("name", ROBOTS)
def test_every_shape_is_one_of_the_files(name: str) -> None:
    """Drawn shapes are the visuals of the URDF files, on the bodies of the system."""
    # nothing touches the walls, as boxes could not
    maze = dataclasses.replace(SCENES["maze"], links=())
    system = build_system(ROBOTS[name], "float32", maze)
    drawing = drawing_of_system(system)
    text = "".join(
        find_urdf(file).read_text(encoding="utf-8")
        for file in (system.robot.urdf, "maze.urdf")
    )
    for tag, visual in (("visual", True), ("collision", False)):
        count = len(re.findall(rf"<{tag}[ >]", text))
        assert sum(shape.visual is visual for shape in drawing.shapes) == count
    assert {shape.body for shape in drawing.shapes} <= set(range(-1, system.nb))
    assert drawing.radius > 0
    fixed = ("acrobot", "grasp", "pusher", "reacher", "reacherangle", "ur5e")
    assert drawing.follow is (name not in fixed)
    target = [s for s in drawing.shapes if s.body < 0 and s.color[3] < 1]
    assert len(target) == 1  # of the maze, which one can see through


@pytest.mark.parametrize(
    ("name", "rise"), [("antmaze_u", 2.2), ("antmaze", 0.45), ("ant_uni", 0.45)]
)
def test_no_wall_hides_the_robot_at_first(name: str, rise: float) -> None:
    """The start of ``antmaze_u`` is 2 m from a wall, which is 2 m high."""
    drawing = drawing_of(newton_qd.create(name))
    x, y, z = offset = camera_offset(drawing)
    assert z / np.hypot(x, y) == pytest.approx(rise)
    assert html.drawing_data(drawing)["camera"] == offset.tolist()
    if name == "antmaze_u":
        walls = [shape for shape in drawing.shapes if shape.body < 0 and shape.visual]
        (wall,) = [shape for shape in walls if shape.frame[1] == -2.5]
        edge = wall.frame[1] + wall.size[1]
        assert edge == -2 and wall.frame[2] + wall.size[2] == 2
        frames = body_frames(drawing, drawing.rest_q)
        for part in drawing.shapes:
            if part.body >= 0:
                place = composed(frames[part.body], part.frame)[:3]
                way = drawing.centre + offset - place
                assert place[2] + way[2] * (edge - place[1]) / way[1] > 2


def test_the_maze_is_that_of_the_environment() -> None:
    env: Any = newton_qd.create("pointmaze")
    drawing = drawing_of(env)
    goal = drawing.shapes[-1]
    assert goal.frame[:2].tolist() == list(env.goal)
    assert goal.size[0] == env.zone_width / 2
    boxes = [s for s in drawing.shapes if s.kind == "box"]
    assert len(boxes) == 7  # two walls, four borders, the goal
    low, high = (
        [float(s.frame[1] + sign * s.size[1]) for s in boxes[:2]] for sign in (-1, 1)
    )
    assert np.allclose(low, [-0.5, 0.2]) and np.allclose(high, [-0.49, 0.21])
    # borders are as thick as the walls
    assert np.allclose([s.size[:2].min() for s in boxes[:6]], 0.005)


def test_arrays_are_encoded() -> None:
    array = np.linspace(-3, 5, 24).reshape(2, 4, 3)
    exact = html.encode(array)
    raw = np.frombuffer(base64.b64decode(exact["data"]), "<f4")
    assert np.array_equal(raw.reshape(exact["shape"]), array.astype(np.float32))
    short = html.encode(array, "int16")
    raw = np.frombuffer(base64.b64decode(short["data"]), "<i2")
    assert (raw.min(), raw.max()) == (-32_767, 32_767)  # no bit is lost
    back = raw.reshape(-1, 3) * short["scale"] + short["offset"]
    assert np.abs(back - array.reshape(-1, 3)).max() < 8 / 65_535
    nothing = html.encode(np.zeros((2, 0, 3)), "int16")  # an episode of one step
    assert nothing["shape"] == [2, 0, 3] and nothing["data"] == ""
    assert np.isfinite([*nothing["scale"], *nothing["offset"]]).all()


def test_names_cannot_end_a_page(walk: Trajectory) -> None:
    title = "</script><script>alert(1)</script><!-- \u202e & '\""
    text = replay_html(walk, title)
    assert text.count("</script>") == text.count("<script")
    assert "<script>alert" not in text and "<!--" not in text.replace("<!doctype", "")
    (found,) = re.findall(r'<script type="application/json" id="data">(.*?)</s', text)
    assert json.loads(found)["title"] == title
    (policy,) = re.findall(r'Policy" content="([^"]*)"', text)
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe" not in policy and "http" not in policy
    with pytest.raises(ValueError, match="Out of range float values"):
        html.json_text({"reward": float("nan")})


def test_a_page_is_small(walk: Trajectory) -> None:
    """1,000 steps of ten ants are below 2 MB."""
    many = joined([walk] * 5)
    frames = np.repeat(many.q[:, :1], 1001, axis=1)
    long = Trajectory(
        drawing=many.drawing,
        q=frames,
        lengths=np.full(10, 1000),
        dt=many.dt,
        rewards=np.zeros((10, 1000)),
        descriptors=np.zeros((10, 1001, 4)),
        descriptor_names=many.descriptor_names,
        feet=np.zeros((10, 1001, 4)),
        labels=many.labels,
    )
    assert len(replay_html(long)) < 2e6


def test_the_bundled_script_has_the_hash_of_its_build() -> None:
    lines = (PAGES / "three.sha256").read_text(encoding="utf-8").splitlines()
    stored = {name: digest for digest, name in map(str.split, lines)}
    assert set(stored) == {"three.min.js", "three.LICENSE"}
    for name, digest in stored.items():
        assert hashlib.sha256((PAGES / name).read_bytes()).hexdigest() == digest
    assert "MIT License" in (PAGES / "three.LICENSE").read_text(encoding="utf-8")


@pytest.mark.slow
def test_an_environment_that_cannot_be_drawn(
    reference: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The points of the tests are no robots: the command says so."""
    assert cli.main(["replay", str(reference)], task_factory=point_task) == 2
    assert "env: got PointEnv; allowed: simulated robots" in capsys.readouterr().err


def test_wrong_arguments_of_replay(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["replay", "antt"]) == 2
    assert "does not exist" in capsys.readouterr().err
    assert cli.main(["replay", "antt", "--cell", "3"]) == 2
    error = capsys.readouterr().err
    assert "DIR|ENV: got 'antt', which does not exist; allowed: a results f" in error
    assert cli.main(["replay", "ant", "--cell", "3"]) == 2
    assert "--cell: got 3; allowed: a results folder" in capsys.readouterr().err
    assert cli.main(["replay", "ant", "--best", "0"]) == 2
    assert "--best: got 0; allowed: None, or integers" in capsys.readouterr().err
    for command in (["replay"], ["render", "--best", "2"]):  # several gigabytes
        assert cli.main([*command, "pointmaze", "--steps", "100000000"]) == 2
        whose, most = "", 1_000_000
        if "2" in command:
            whose, most = " of each of 2 worlds", 500_000
        said = f"--steps{whose}: got 100000000; allowed: integers from 1 to {most}\n"
        assert said in capsys.readouterr().err


def test_frames_of_bodies_are_those_of_the_reference() -> None:
    rng = np.random.default_rng(0)
    for name in ("ant", "walker2d", "pusher"):
        system = build_system(ROBOTS[name], "float32")
        drawing = drawing_of_system(system)
        q = system.rest_q + rng.uniform(-1, 1, (2, 3, system.nq))
        found = body_frames(drawing, q)
        assert np.allclose(found[1, 2], reference_frames(system, q[1, 2]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--gif", "--time", "1"], "--time: got 1.0, which has no effect on ant.gif;"),
        (["--png", "--rate", "5"], "--rate: got 5.0, which has no effect on ant.png;"),
    ],
)
def test_render_refuses_what_it_would_ignore(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert cli.main(["render", "ant", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_render_does_not_replace_the_picture_of_a_run(
    reference: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = reference / "archive.png"
    before = picture.read_bytes()
    for shown in (reference, "ant"):
        arguments = ["render", str(shown), "--png", "--out", str(picture)]
        assert cli.main(arguments, task_factory=point_task) == cli.BAD_ARGUMENTS
        assert "which is the picture of the archive of a run" in capsys.readouterr().err
    assert picture.read_bytes() == before


def test_a_gif_has_the_speed_of_its_rate() -> None:
    """Its unit is a hundredth of a second, and errors must not add up."""
    for rate in (7.0, 20.0, 30.0, 50.0):
        found = _durations(90, rate)
        assert abs(sum(found) - 1000 * 90 / rate) <= 5
        assert all(x % 10 == 0 and abs(x - 1000 / rate) < 10 for x in found)


@pytest.mark.parametrize("rate", [0.001, 60.0])
def test_a_gif_cannot_have_any_rate(
    rate: float, walk: Trajectory, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=r"rate of a GIF: got .*; allowed: .* 50"):
        render(walk, tmp_path / "a.gif", rate=rate)


def test_moments_beyond_the_end_are_refused(walk: Trajectory, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"time: got 99; allowed: numbers .* to 0\.25"):
        render(walk, tmp_path / "late.png", time=99)
    with pytest.raises(ValueError, match=r"time: got 0\.1, and a \.gif file shows all"):
        render(walk, tmp_path / "walk.gif", time=0.1)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_an_episode_has_its_length(
    reference: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drawn = load_run(reference, task_factory=point_task)
    with pytest.raises(ValueError, match=r"steps: got 10; allowed: None, or .* 1 to 9"):
        record_elites(drawn, drawn.cells[:1], steps=10)
    for cells in ("a", [1.5]):
        with pytest.raises(IndexError, match=r"cell: got .*; allowed: integers from 0"):
            record_elites(drawn, cells)  # type: ignore[arg-type]
    arguments = ["replay", str(reference), "--seed", "1"]
    assert cli.main(arguments, task_factory=point_task) == 2
    assert "--seed: got 1, and elites begin where their run" in capsys.readouterr().err


@pytest.mark.slow
def test_pictures(walk: Trajectory, tmp_path: Path) -> None:
    from PIL import Image

    seen: list[tuple[int, int]] = []
    size: Any = {"width": 64, "height": 48}
    path = render(walk, tmp_path / "two.png", **size, time=0.1)
    with Image.open(path) as image:
        picture = np.asarray(image.convert("RGB"), int)
    assert picture.shape == (48, 128, 3)  # a sheet of two worlds
    brown = picture[..., 0] > picture[..., 2] + 40
    rows, columns = np.nonzero(brown[:, :64])
    # the robot is in the middle of its picture
    assert 0.02 < brown.mean() < 0.5 and abs(columns.mean() - 32) < 8
    assert abs(rows.mean() - 24) < 10
    one = walk.world(0)
    path = render(one, tmp_path / "one.gif", **size, progress=lambda *a: seen.append(a))
    with Image.open(path) as image:
        assert getattr(image, "n_frames", 1) == 6 and image.info["duration"] == 50
    assert seen == [(k, 6) for k in range(1, 7)]
    path = render(one, tmp_path / "one.mp4", **size)
    assert path.read_bytes()[4:8] == b"ftyp"
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "one.gif",
        "one.mp4",
        "two.png",
    ]
    with pytest.raises(ValueError, match=r"path: got .*; allowed: files with .png"):
        render(one, tmp_path / "one.webm")
    above = render(one, tmp_path / "above.png", **size, time=0.1, elevation=89)
    with Image.open(above) as image:
        seen_above = np.asarray(image.convert("RGB"), int)
    assert np.abs(seen_above - picture[:, :64]).mean() > 1
    with pytest.raises(ValueError, match=r"elevation: got 90; allowed: "):
        render(one, tmp_path / "one.png", elevation=90)
    with pytest.raises(ValueError, match=r"rate: got 1000000000\.0; .* up to 1000"):
        render(one, tmp_path / "one.mp4", rate=1e9)
    with pytest.raises(ValueError, match="width: got 1; allowed: integers from 2"):
        render(one, tmp_path / "one.mp4", width=1)
    name = "run\udcff"  # a folder whose name is no text
    assert "run?" in write_replay(one, tmp_path / "one.html", name).read_text()


def test_a_video_that_is_not_complete_leaves_the_old_one(
    walk: Trajectory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a full disk, where ffmpeg says nothing to its caller."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg")

    def half(path: Path, *_: Any, **__: Any) -> Iterator[None]:
        assert path.is_absolute(), "before a colon, ffmpeg sees a protocol"
        path.write_bytes(b"half a video")
        while True:
            yield

    def broken(*_: Any, **__: Any) -> Iterator[None]:
        yield
        raise OSError("Broken pipe\n\nFFMPEG COMMAND:\nffmpeg -y")

    # what is in the pictures does not matter here
    blank = SimpleNamespace(picture=lambda q: np.zeros((32, 32, 3), np.uint8))
    monkeypatch.setattr(camera, "Camera", lambda *_: blank)
    target = tmp_path / "one.mp4"
    target.write_bytes(b"old")
    for writer, why in ((half, "no complete video"), (broken, "stopped: Broken pipe$")):
        monkeypatch.setattr(ffmpeg, "write_frames", writer)
        with pytest.raises(OSError, match=rf"one\.mp4 is not written: ffmpeg .*{why}"):
            render(walk.world(0), target, width=32, height=32, rate=5)
        assert target.read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1


def test_contacts_with_physical_parameters_are_refused() -> None:
    """They would be those of the robot's own parameters."""
    env = newton_qd.create("ant_uni", episode_length=2, auto_reset=False)
    plan, key = np.zeros((2, 8), np.float32), jax.random.key(0)
    with pytest.raises(ValueError, match=r"contacts: got True, and .*; allowed: False"):
        record(env, plan, key, contacts=True, params=env.default_params)
