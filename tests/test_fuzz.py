"""Files of others cause documented errors only, read and write nothing else, and end.

``--fuzz-cases 2000`` makes 2,000 cases, in all kinds together.
"""

from __future__ import annotations

import contextlib
import gc
import re
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import hostile
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from urdf_text import row

import newton_qd
from newton_qd.physics.model import (
    RobotDescriptionError,
    RobotDescriptionWarning,
    build_system,
    newton_builder,
)
from newton_qd.physics.model.scene import read_scene
from newton_qd.qd.config import ConfigError, read_config
from newton_qd.qd.run.archive import ArchiveError, load_archive
from newton_qd.qd.run.checkpoint import CheckpointError, load_checkpoint
from newton_qd.robots import ANT
from newton_qd.scenes import Scene

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("no_network")]

KINDS = 5
SECONDS = 20.0  # for one case, also on a busy machine
GROWTH = 64 * 2**20  # memory of the process [bytes]
ROOT = Path(__file__).resolve().parent.parent


class Guard:
    """Sees every file that is opened while it is active.

    Python cannot remove an audit hook, so there is one for all tests.
    """

    def __init__(self) -> None:
        self.folder: Path | None = None
        self.outside: list[str] = []
        sys.addaudithook(self._hook)

    def _hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.folder is None or event not in ("open", "os.remove", "os.rename"):
            return
        if not isinstance(arguments[0], str | bytes | Path):
            return
        path = Path(str(arguments[0])).absolute()
        writes = event != "open" or "w" in str(arguments[1]) or "a" in str(arguments[1])
        installed = [
            ROOT,
            Path(sys.prefix),
            Path(sys.base_prefix),
            Path("/usr"),
            Path("/sys"),
            Path("/proc"),
        ]
        allowed = [self.folder] if writes else [self.folder, *installed]
        if not any(path.is_relative_to(place) for place in allowed):
            self.outside.append(f"{event} {path}")


GUARD = Guard()


@pytest.fixture(scope="module", autouse=True)
def warm() -> None:
    """Loads what is loaded once, so that nothing is opened for it later."""
    newton_qd.create("hopper")
    newton_builder(str(ROOT / "urdf" / "hopper.urdf"), True, 9.81)


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    inside = tmp_path / "robot"
    inside.mkdir()
    for name, text in hostile.MESHES.items():
        (inside / name).write_text(text, encoding="utf-8")
    newton_builder(str(robot_file(inside, MESH.encode())), True, 9.81)
    build_system(ANT, "float32")  # what Newton loads once is no file of a case
    yield inside
    assert not (tmp_path / "evil.npy").exists() and not (inside / "evil").exists()


MESH = """<robot name="r"><link name="a"><visual><geometry><mesh filename="a.obj"/>
</geometry></visual></link></robot>"""


def robot_file(folder: Path, content: bytes) -> Path:
    path = folder / "robot.urdf"
    path.write_bytes(content)
    return path


def fuzz(
    config: pytest.Config,
    folder: Path,
    cases: st.SearchStrategy[Any],
    call: Callable[[Any], object],
    documented: tuple[type[Exception], ...],
) -> None:
    """Calls a function with many cases; only documented errors may leave it."""
    sizes = []
    cases_in_all: Any = config.getoption("--fuzz-cases")
    all_checks: Any = list(HealthCheck)

    @settings(
        max_examples=max(cases_in_all // KINDS, 1),
        deadline=None,
        database=None,
        derandomize=True,
        phases=[Phase.generate],  # what fails is shown as it is, after a bounded time
        suppress_health_check=all_checks,
    )
    @given(cases)
    def run(case: Any) -> None:
        begin = time.monotonic()
        GUARD.outside.clear()
        GUARD.folder = folder
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                warnings.simplefilter("ignore", RobotDescriptionWarning)
                call(case)
        except documented as error:
            assert str(error)
        finally:
            GUARD.folder = None
        assert not GUARD.outside, GUARD.outside
        assert time.monotonic() - begin < SECONDS
        sizes.append(resident())

    run()
    gc.collect()
    assert resident() - sizes[min(len(sizes) - 1, 20)] < GROWTH


def resident() -> int:
    """Memory of this process [bytes]; 0 where the system does not tell."""
    path = Path("/proc/self/statm")
    return int(path.read_text().split()[1]) * 4096 if path.exists() else 0


def load_robot(folder: Path, content: bytes) -> None:
    path = robot_file(folder, content)
    found = re.search(rb'<link name="([^"]+)"', content)
    torso = found[1].decode("utf-8", "replace") if found else "a"
    torso = "torso" if b'<link name="torso"' in content else torso
    with contextlib.suppress(RobotDescriptionError):
        read_scene(Scene("fuzz", str(path)))
    build_system(row(str(path), torso), "float32")
    newton_builder(str(path), True, 9.81)


def test_robots(pytestconfig: pytest.Config, folder: Path) -> None:
    cases = hostile.robots()
    fuzz(
        pytestconfig,
        folder,
        cases,
        lambda text: load_robot(folder, text.encode("utf-8", "replace")),
        (RobotDescriptionError,),
    )


def test_changed_robots(pytestconfig: pytest.Config, folder: Path) -> None:
    cases = hostile.changed_robots()
    call = lambda content: load_robot(folder, content)  # noqa: E731
    fuzz(pytestconfig, folder, cases, call, (RobotDescriptionError,))


def test_settings(pytestconfig: pytest.Config, folder: Path) -> None:
    def call(case: tuple[str, bytes]) -> None:
        name, content = case
        (folder / name).write_bytes(content)
        read_config(folder / name)

    fuzz(pytestconfig, folder, hostile.settings_files(), call, (ConfigError,))


def test_archives(pytestconfig: pytest.Config, folder: Path) -> None:
    def call(content: bytes) -> None:
        (folder / "archive.npz").write_bytes(content)
        load_archive(folder)

    fuzz(pytestconfig, folder, hostile.ARCHIVES, call, (ArchiveError,))


def test_checkpoints(pytestconfig: pytest.Config, folder: Path) -> None:
    def call(content: bytes) -> None:
        (folder / "checkpoint.bin").write_bytes(content)
        load_checkpoint(folder / "checkpoint.bin")

    fuzz(pytestconfig, folder, hostile.checkpoints(), call, (CheckpointError,))
