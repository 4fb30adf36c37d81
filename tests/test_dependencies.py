"""What pyproject.toml says of other packages: all that are imported, with bounds."""

from __future__ import annotations

import ast
import functools
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from newton_qd.compat.finder import SUPPORTED

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))[
    "project"
]
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]
REQUIREMENTS = sorted(
    {
        requirement
        for group in (PROJECT["dependencies"], *EXTRAS.values())
        for requirement in group
        if not requirement.startswith("newton_qd[")
    }
)
# Distributions that are not named as what they install.
DISTRIBUTIONS = {
    "PIL": "pillow",
    "griffe": "griffelib",
    "imageio_ffmpeg": "imageio-ffmpeg",
    "warp": "warp-lang",
}
NOT_IN_ALL = ("torch",)  # too large to install for every test
FOLDERS = ("newton_qd", "tests", "benchmarks", "examples", "docs")


def distribution(requirement: str) -> str:
    """Name in front of the bounds and the extras."""
    return re.split(r"[^\w-]", requirement)[0]


def declared(*extras: str) -> set[str]:
    """Distributions that the core and some extras need."""
    found = set(map(distribution, PROJECT["dependencies"]))
    for extra in extras:
        for requirement in EXTRAS[extra]:
            own = re.fullmatch(r"newton_qd\[(.*)\]", requirement)
            if own:
                found |= declared(*own[1].split(","))
            else:
                found.add(distribution(requirement))
    return found


@functools.cache
def imported(folder: Path) -> tuple[tuple[str, str], ...]:
    """File and root of every import in a folder that is not of Python."""
    return tuple(_imported(folder))


def _imported(folder: Path) -> Iterator[tuple[str, str]]:
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names: list[str] = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level:
                names = [node.module or ""]
            for name in names:
                root = name.partition(".")[0]
                if root not in sys.stdlib_module_names:
                    yield path.relative_to(ROOT).as_posix(), root


@pytest.mark.parametrize("folder", FOLDERS)
def test_every_import_is_declared(folder: str) -> None:
    ours = {"newton_qd"} | {
        path.stem for name in FOLDERS[1:] for path in (ROOT / name).rglob("*.py")
    }
    names = declared("all", *NOT_IN_ALL)
    # what cannot be installed beside this package, and is not part of it
    for path in (ROOT / folder).glob("*-requirements.txt"):
        names |= {distribution(line) for line in path.read_text().splitlines()}
    missing = {
        f"{path}: {root}"
        for path, root in imported(ROOT / folder)
        if root not in ours and DISTRIBUTIONS.get(root, root) not in names
    }
    assert not missing


def test_the_package_needs_no_extra_of_developers() -> None:
    names = declared(
        "qd", "ribs", "tensorboard", "viz", "video", "gym", "brax", "torch"
    )
    missing = {
        f"{path}: {root}"
        for path, root in imported(ROOT / "newton_qd")
        if root != "newton_qd" and DISTRIBUTIONS.get(root, root) not in names
    }
    assert not missing


@pytest.mark.parametrize("requirement", REQUIREMENTS)
def test_both_bounds_are_stated(requirement: str) -> None:
    both = ">=" in requirement and re.search(r"<\d", requirement)
    assert both or "==" in requirement


@pytest.mark.parametrize("extra", ["cuda12", "cuda13"])
def test_extras_for_gpus_have_the_bounds_of_the_core(extra: str) -> None:
    (core,) = [one for one in PROJECT["dependencies"] if distribution(one) == "jax"]
    assert EXTRAS[extra] == [core.replace("jax", f"jax[{extra}]")]
    assert not any("cuda" in one for one in EXTRAS["all"])


def test_qdax_is_a_release_that_compat_accepts() -> None:
    (requirement,) = [one for one in REQUIREMENTS if distribution(one) == "qdax"]
    assert requirement == f"qdax=={SUPPORTED[-1]}" and len(SUPPORTED) == 1
