"""Wheel and source distribution: what they hold, and what they need."""

from __future__ import annotations

import email
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from fresh_python import run_python

ROOT = Path(__file__).resolve().parent.parent
CORE_DEPENDENCIES = {"jax", "newton", "numpy", "warp-lang"}


@pytest.fixture(scope="module")
def distributions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the wheel and the source distribution of this checkout."""
    folder = tmp_path_factory.mktemp("distributions")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-d", str(folder)],
        cwd=ROOT,
        check=True,
        stdin=subprocess.DEVNULL,
        timeout=300,
        capture_output=True,
    )
    return folder


def urdf_names() -> set[str]:
    """File names of the suite's robots and scenes."""
    return {path.name for path in (ROOT / "urdf").glob("*.urdf")}


def test_wheel_holds_the_robots(distributions: Path, tmp_path: Path) -> None:
    (wheel,) = distributions.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        held = {
            name.removeprefix("newton_qd/urdf/")
            for name in archive.namelist()
            if name.startswith("newton_qd/urdf/")
        }
        archive.extractall(tmp_path)
    assert "ant.urdf" in held
    assert urdf_names() <= held
    code = "from newton_qd.assets import find_urdf; print(find_urdf('ant.urdf'))"
    result = run_python(code, tmp_path, PYTHONPATH=str(tmp_path))
    assert result.returncode == 0, result.stderr
    found = Path(result.stdout.strip()).resolve()
    assert found == (tmp_path / "newton_qd" / "urdf" / "ant.urdf").resolve()


def test_wheel_holds_the_pages(distributions: Path) -> None:
    (wheel,) = distributions.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        held = set(archive.namelist())
    pages = {path.name for path in (ROOT / "newton_qd" / "viewing" / "pages").iterdir()}
    assert {"three.min.js", "three.LICENSE", "explorer.js", "style.css"} <= pages
    assert {f"newton_qd/viewing/pages/{name}" for name in pages} <= held


def test_wheel_says_that_it_is_typed(distributions: Path) -> None:
    (wheel,) = distributions.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        assert "newton_qd/py.typed" in archive.namelist()


def test_source_distribution_holds_the_robots(distributions: Path) -> None:
    (sdist,) = distributions.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    assert {f"urdf/{name}" for name in urdf_names()} <= held
    assert {"LICENSE", "README.md", "pyproject.toml"} <= held


def test_core_dependencies(distributions: Path) -> None:
    (wheel,) = distributions.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith("/METADATA"))
        metadata = email.message_from_bytes(archive.read(name))
        scripts = archive.read(name.replace("METADATA", "entry_points.txt")).decode()
    required = metadata.get_all("Requires-Dist", [])
    core = [requirement for requirement in required if "extra ==" not in requirement]
    assert all(">=" in requirement for requirement in core), "no lower bound"
    assert {re.split(r"[^\w-]", entry)[0] for entry in core} == CORE_DEPENDENCIES
    extras = set(metadata.get_all("Provides-Extra", []))
    assert {"qd", "viz", "docs", "dev", "all"} <= extras
    assert "newton-qd = newton_qd.cli:main" in scripts
