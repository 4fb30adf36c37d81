"""What Newton built is kept for the next process, and is as if it had built it now."""

from __future__ import annotations

import dataclasses
import functools
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from fresh_python import run_python
from urdf_text import link, robot_text, row, sphere, write

from newton_qd.physics.model import build, kept_models
from newton_qd.physics.model.build import build_system
from newton_qd.physics.system import System
from newton_qd.robots import ANT, ROBOTS, RobotSpec

TESTS = Path(__file__).resolve().parent


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of compiled kernels, for this test alone."""
    monkeypatch.setattr(kept_models, "kernel_cache", lambda: str(tmp_path / "kernels"))
    return tmp_path / "kernels" / "newton_qd_models"


@pytest.fixture
def builds(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """The files that Newton builds."""
    found: list[str] = []
    builder = build.newton_builder

    def counted(path: str, *arguments: object) -> object:
        found.append(path)
        return builder(path, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(build, "newton_builder", counted)
    yield found


def load(robot: RobotSpec) -> System:
    """What ``load_system`` returns in a new process."""
    with pytest.MonkeyPatch.context() as patch:  # other tests hold systems of this one
        empty = functools.cache(build._cached_system.__wrapped__)
        patch.setattr(build, "_cached_system", empty)
        return build.load_system(robot)


def assert_equal(left: System, right: System) -> None:
    for field in dataclasses.fields(System):
        a, b = (getattr(x, field.name) for x in (left, right))
        if isinstance(a, np.ndarray):
            assert a.dtype == b.dtype and a.shape == b.shape, field.name
            np.testing.assert_array_equal(a, b, field.name)
        else:
            assert a == b, field.name


@pytest.mark.parametrize("name", ROBOTS)
def test_a_kept_robot_is_a_built_one(
    name: str, folder: Path, builds: list[str]
) -> None:
    robot = ROBOTS[name]
    first, again = load(robot), load(robot)
    assert len(builds) == 1 and len(list(folder.iterdir())) == 1
    assert_equal(again, first)
    assert_equal(again, build_system(robot, "float32"))
    assert len(builds) == 2  # build_system always asks Newton


def flipped(path: Path, place: int) -> None:
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-200]),
    "text": lambda path: path.write_text("no model"),
    "first bit": lambda path: flipped(path, 0),
    "a bit of the digest's end": lambda path: flipped(path, 31),
    "a bit of the content": lambda path: flipped(path, 400),
    "last bit": lambda path: flipped(path, -1),
    "a folder": lambda path: (path.unlink(), path.mkdir()),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_built_again(
    damage: str, folder: Path, builds: list[str]
) -> None:
    expected = load(ANT)
    (path,) = folder.iterdir()
    DAMAGES[damage](path)
    assert_equal(load(ANT), expected)
    assert len(builds) == 2
    assert_equal(load(ANT), expected)
    if damage != "a folder":  # which no file replaces
        assert len(builds) == 2 and list(folder.iterdir()) == [path]


def test_a_model_that_is_not_the_robot_is_built_again(
    folder: Path, builds: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = load(ANT)
    read = kept_models._read
    with monkeypatch.context() as patch:
        patch.setattr(
            kept_models,
            "_read",
            lambda path: dataclasses.replace(read(path), mass=expected.mass * 1.01),  # type: ignore[type-var]
        )
        assert_equal(load(ANT), expected)
    assert len(builds) == 2


def test_other_users_can_read_what_is_kept(folder: Path) -> None:
    before = os.umask(0o022)
    try:
        load(ANT)
    finally:
        os.umask(before)
    (path,) = folder.iterdir()
    assert stat.S_IMODE(path.stat().st_mode) == 0o644


def test_a_folder_that_cannot_be_written_is_no_error(
    folder: Path, builds: list[str]
) -> None:
    folder.parent.write_text("a file")
    assert_equal(load(ANT), load(ANT))
    assert len(builds) == 2


def test_an_edited_file_is_another_robot(
    tmp_path: Path, folder: Path, builds: list[str]
) -> None:
    for mass in (1.0, 4.0, 1.0):
        text = robot_text(link("trunk", sphere(0.1), mass))
        robot = row(write(tmp_path, text), "trunk")
        assert load(robot).mass.tolist() == [mass]
    assert len(builds) == 2
    load(dataclasses.replace(robot, gravity=1.0))
    assert len(builds) == 3


def test_other_versions_build_again(
    folder: Path, builds: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    load(ANT)
    version = kept_models.importlib.metadata.version

    def newer(name: str) -> str:
        return "99.0" if name == "newton" else version(name)

    monkeypatch.setattr(kept_models.importlib.metadata, "version", newer)
    load(ANT)
    assert len(builds) == 2


@pytest.mark.slow
def test_a_later_process_does_not_import_newton(tmp_path: Path) -> None:
    code = (
        "import sys, newton_qd\n"
        "from newton_qd.physics.model import kept_models\n"
        f"kept_models.kernel_cache = lambda: {str(tmp_path)!r}\n"
        "newton_qd.create('hopper')\n"
        "print('newton' in sys.modules)\n"
    )
    for imported in (True, False):
        done = run_python(code, TESTS)
        assert done.stdout == f"{imported}\n", done.stdout + done.stderr
