"""QDax's own tests of environments pass with this library's, after one call.

The tests come from QDax's source package (MIT licence), which is downloaded from the
package index once and kept in pytest's cache. None of it is part of this project.
Without a network the test is skipped, with the reason.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import processes
import pytest

pytestmark = pytest.mark.slow

RELEASE = "qdax==0.5.0"
FOLDER = "environments_test"
# QDax's tests need the plugin pytest-assume, for which an assertion stands in.
SET_UP = """
import pytest
import newton_qd.compat

newton_qd.compat.install()


def assume(condition, message=""):
    assert condition, message


pytest.assume = assume
"""


def source_tests(cache: Path) -> Path:
    """Folder with a copy of QDax's tests of environments."""
    folder = cache / FOLDER
    if folder.is_dir():
        return folder
    part = cache / "part"
    shutil.rmtree(part, ignore_errors=True)
    options = ["--no-deps", "--no-binary=:all:", "--retries=1", "--timeout=15"]
    command = [sys.executable, "-m", "pip", "download", "--quiet", *options]
    process = processes.start([*command, "--dest", str(part), RELEASE], seconds=200.0)
    _, errors = process.communicate()
    if process.returncode != 0:
        last = (errors.strip().splitlines() or ["no message"])[-1]
        pytest.skip(f"{RELEASE} cannot be downloaded: {last}")
    (part / FOLDER).mkdir()
    with tarfile.open(next(part.glob("*.tar.gz"))) as archive:
        for item in archive.getmembers():
            content = archive.extractfile(item)
            if f"/tests/{FOLDER}/" in item.name and content is not None:
                target = part / FOLDER / Path(item.name).name
                target.write_bytes(content.read())
    return (part / FOLDER).rename(folder)


def test_tests_of_qdax_pass(pytestconfig: pytest.Config, tmp_path: Path) -> None:
    assert pytestconfig.cache is not None
    source = source_tests(pytestconfig.cache.mkdir("qdax_source"))
    shutil.copytree(source, tmp_path / FOLDER)
    (tmp_path / "conftest.py").write_text(SET_UP, encoding="utf-8")
    (tmp_path / "pytest.ini").write_text("[pytest]\n", encoding="utf-8")
    # the humanoid has joints of every kind; all six tests take three times as long
    chosen = ["-k", "pointmaze or humanoid_uni"]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *chosen]
    done = subprocess.run(
        [*command, str(tmp_path)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout
    assert "2 passed" in done.stdout
