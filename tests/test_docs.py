"""The documentation that is written from the code."""

from __future__ import annotations

import ast
import functools
import importlib.util
import json
import re
import shlex
import sys
from pathlib import Path
from types import ModuleType

import pytest

import newton_qd

DOCS = Path(__file__).resolve().parents[1] / "docs"


def load(name: str) -> ModuleType:
    """A script of the documentation, as a module."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def generate() -> ModuleType:
    return load("generate")


def test_environments_page_is_up_to_date(generate: ModuleType) -> None:
    written = (DOCS / "environments.md").read_text(encoding="utf-8")
    assert written == generate.page(), "run: python docs/generate.py"


def test_algorithms_on_the_evolve_page_are_up_to_date(generate: ModuleType) -> None:
    written = (DOCS / "evolve.md").read_text(encoding="utf-8")
    assert written == generate.evolve_page(), "run: python docs/generate.py"


def test_options_of_the_algorithms_are_up_to_date(generate: ModuleType) -> None:
    written = (DOCS / "algorithm_options.md").read_text(encoding="utf-8")
    assert written == generate.options_page(), "run: python docs/generate.py"


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
    for package in re.findall(r"^import (torch)$", text, re.M):
        pytest.importorskip(package)  # not in the extra `all`
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


def commands(page: str) -> list[list[str]]:
    """Arguments of every call of `newton-qd` in the bash blocks of a page."""
    text = "\n".join(blocks(page, "bash")).replace("\\\n", " ")
    found = [shlex.split(part, comments=True) for part in re.split(r"\n|&&", text)]
    name = "newton-qd"
    return [words[words.index(name) + 1 :] for words in found if name in words]


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)])
def test_commands_on_a_page_are_understood(
    page: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from newton_qd import cli

    monkeypatch.setattr(cli, "_run", lambda arguments, factory: cli.OK)
    for arguments in commands(page):
        assert cli.main(arguments) == cli.OK, arguments


def test_only_a_cluster_needs_a_fragment() -> None:
    fragments = [b for page in PAGES for b in blocks(page) if "# fragment" in b]
    assert len(fragments) == 1 and "jax.distributed.initialize" in fragments[0]


def test_the_gallery_has_every_environment() -> None:
    gallery = load("gallery")
    written = (DOCS / "gallery.md").read_text(encoding="utf-8")
    assert written == gallery.page(), "run: python docs/gallery.py"
    pictures = {path.stem for path in gallery.FOLDER.glob("*.gif")}
    assert pictures == {*newton_qd.registered_envs(), "evolved"}
    size = sum(path.stat().st_size for path in gallery.FOLDER.iterdir())
    assert size < 1.4e5 * len(pictures)


ROOT = DOCS.parent
PACKAGE = ROOT / "newton_qd"
# Modules with public names that have no place of their own in the reference.
ELSEWHERE = {
    "newton_qd.cli": "the command line: `newton-qd --help`",
    "newton_qd.compat.brax_envs": "names of QDax, in coming_from_qdax.md",
    "newton_qd.compat.brax_v1": "names of brax, in coming_from_qdax.md",
    "newton_qd.compat.env_creators": "names of QDax, in coming_from_qdax.md",
    "newton_qd.physics.native": "the way into the kernels of a CPU",
}


def file_of(module: str) -> Path:
    path = ROOT / module.replace(".", "/")
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


@functools.cache
def imported(module: str) -> dict[str, str]:
    """What a module imports from modules of ours, by the name there."""
    return {
        alias.asname or alias.name: f"{node.module}.{alias.name}"
        for node in ast.walk(ast.parse(file_of(module).read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module != module
        for alias in node.names
        if node.module and node.module.startswith("newton_qd")
    }


def home(name: str) -> str:
    """Where an object is defined, without an import: `__init__` files import it."""
    module, _, own = name.rpartition(".")
    source = imported(module).get(own)
    return home(source) if source else name


def public_names(module: str) -> list[str]:
    """What `__all__` of a module has."""
    for node in ast.parse(file_of(module).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return [f"{module}.{name}" for name in ast.literal_eval(node.value)]
    return []


def test_the_reference_has_every_public_name() -> None:
    pages = "".join(path.read_text(encoding="utf-8") for path in DOCS.glob("api/*.md"))
    written = re.findall(r"^::: ([\w.]+)$", pages, re.M)
    assert len(written) == len(set(written))
    whole = [name for name in written if file_of(name).is_file()]
    written += [name for module in whole for name in public_names(module)]
    described = set(map(home, written))
    modules = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for path in PACKAGE.rglob("*.py")
    ]
    names = {
        name
        for module in modules
        if module not in ELSEWHERE
        for name in public_names(module)
    }
    assert len(names) > 200
    missing = {name for name in names if home(name) not in described}
    assert not missing, "add a line `::: NAME` to a page of docs/api"
    assert set(ELSEWHERE) <= set(modules)


def test_dead_links_and_other_hosts_are_found(tmp_path: Path) -> None:
    assert load("check_site").faults(tmp_path) == [f"{tmp_path} has no pages"]
    (tmp_path / "a").mkdir()
    (tmp_path / "index.html").write_text(
        '<p id="top"><a href="a/#one">good</a> <a href="a/#two">bad</a>'
        '<a href="b/">bad</a> <a href="https://example.org">good</a>'
        '<link rel="canonical" href="https://example.org/">'
        '<script src="//cdn.example.org/x.js"></script><img src="no.png">'
    )
    (tmp_path / "a" / "index.html").write_text('<h1 id="one"><a href="../#top">up</a>')
    (tmp_path / "a" / "x.css").write_text("@import url(https://fonts.example.org/x);")
    assert load("check_site").faults(tmp_path) == [
        "index.html: loads //cdn.example.org/x.js",
        "index.html: no.png does not exist",
        "index.html: a/#two has no such place",
        "index.html: b/ does not exist",
        "a/x.css: loads https://fonts.example.org/x",
    ]


def test_an_item_that_has_left_its_list_is_found(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text(
        "<ul><li><p>good - one</p></li></ul><p>some text\n- <b>lost</b> item</p>"
    )
    assert load("check_site").faults(tmp_path) == [
        "index.html: no item of a list: - lost item"
    ]


@pytest.mark.parametrize("name", ["README", "CONTRIBUTING", "CHANGELOG"])
def test_links_of_the_first_pages_lead_to_files(name: str) -> None:
    text = (ROOT / f"{name}.md").read_text(encoding="utf-8")
    links = re.findall(r"\]\((?!https?:)([^)#]+)", text)
    assert links and not [link for link in links if not (ROOT / link).exists()]


NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_small_and_has_its_outputs(path: Path) -> None:
    assert path.stat().st_size < 100_000
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4 and notebook["nbformat_minor"] >= 5
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    numbers = [cell["execution_count"] for cell in cells]
    assert numbers == [*range(1, len(cells) + 1)], "run: python docs/notebooks.py"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(
    path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """In a new folder; each cell still has the kinds of outputs that are saved."""
    from newton_qd import tasks

    monkeypatch.setattr(tasks, "ENVIRONMENTS", dict(tasks.ENVIRONMENTS))
    monkeypatch.chdir(tmp_path)

    def kinds(outputs: list[dict[str, object]]) -> list[object]:
        return [output["output_type"] for output in outputs]

    for cell, outputs in load("notebooks").run(path):
        assert kinds(outputs) == kinds(cell["outputs"])
