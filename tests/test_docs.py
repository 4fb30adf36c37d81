"""The documentation that is written from the code."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

import newton_qd

DOCS = Path(__file__).resolve().parents[1] / "docs"


@pytest.fixture(scope="module")
def generate() -> ModuleType:
    spec = importlib.util.spec_from_file_location("generate", DOCS / "generate.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_environments_page_is_up_to_date(generate: ModuleType) -> None:
    written = (DOCS / "environments.md").read_text(encoding="utf-8")
    assert written == generate.page(), "run: python docs/generate.py"


def test_algorithms_on_the_evolve_page_are_up_to_date(generate: ModuleType) -> None:
    written = (DOCS / "evolve.md").read_text(encoding="utf-8")
    assert written == generate.evolve_page(), "run: python docs/generate.py"


PAGES = [path.name for path in sorted(DOCS.glob("*.md"))]


def blocks(page: str, language: str = "python") -> list[str]:
    text = (DOCS / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.M | re.S)


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)])
def test_python_on_a_page_can_be_compiled(page: str) -> None:
    for block in blocks(page):
        compile(block, page, "exec")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)])
def test_python_on_a_page_runs_as_pasted(
    page: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """In a new folder, from the first block on; XML is saved as the page says."""
    from newton_qd import compat, tasks
    from newton_qd.qd.algorithms import _REGISTERED

    monkeypatch.setattr(tasks, "ENVIRONMENTS", dict(tasks.ENVIRONMENTS))
    monkeypatch.chdir(tmp_path)
    text = (DOCS / page).read_text(encoding="utf-8")
    for name, xml in zip(
        re.findall(r"[Ss]ave it as `(.*?\.urdf)`", text),
        blocks(page, "xml"),
        strict=True,
    ):
        (tmp_path / name).write_text(xml, encoding="utf-8")
    names: dict[str, object] = {"__name__": "pasted"}
    module = ModuleType("pasted")  # dataclasses look their module up
    monkeypatch.setitem(sys.modules, "pasted", module)
    try:
        for block in blocks(page):
            if not block.startswith("# fragment"):
                exec(compile(block, page, "exec"), names)
    finally:
        compat.uninstall()
        _REGISTERED.clear()


def test_only_a_cluster_needs_a_fragment() -> None:
    fragments = [b for page in PAGES for b in blocks(page) if "# fragment" in b]
    assert len(fragments) == 1 and "jax.distributed.initialize" in fragments[0]


def test_the_gallery_has_every_environment() -> None:
    spec = importlib.util.spec_from_file_location("gallery", DOCS / "gallery.py")
    assert spec is not None and spec.loader is not None
    gallery = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(gallery)
    written = (DOCS / "gallery.md").read_text(encoding="utf-8")
    assert written == gallery.page(), "run: python docs/gallery.py"
    pictures = {path.stem for path in gallery.FOLDER.glob("*.gif")}
    assert pictures == {*newton_qd.registered_envs(), "evolved"}
    assert sum(path.stat().st_size for path in gallery.FOLDER.iterdir()) < 4e6
