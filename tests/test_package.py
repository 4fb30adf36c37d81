"""The package as a whole: import arrows, packages in their home, light import."""

from __future__ import annotations

import ast
import functools
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from fresh_python import run_python
from mutate import MUTATIONS

import newton_qd

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "newton_qd"
# where the package under test is: the checkout, or an installation
TESTED = Path(newton_qd.__file__).parent.parent

# A module may import those of its own name and those before it.
LAYERS = (
    "checks",
    "real_numbers",
    "errors",
    "figure",
    "files",
    "lazy",
    "memory",
    "moved",
    "types",
    "assets",
    "robots",
    "scenes",
    "physics",
    "envs",
    "extractors",
    "wrappers",
    "brax_views",
    "tasks",
    "tables",
    "registration",
    "registry",
    "authoring",
    "gradients",
    "__init__",
)
# Leaves read every layer, and these leaves.
LEAVES: dict[str, set[str]] = {
    "adapters": {"viewing"},
    "compat": {"viewing"},
    "qd": {"compat"},
    "viewing": {"qd"},
    "cli": {"qd", "compat", "viewing"},
    "__main__": {"cli"},
}
# The rooms of `qd`: a module may import those of its own room and those before it.
ROOMS = (
    "facts",
    "config",
    "study",
    "scoring",
    "emitters",
    "algorithms",
    "run",
    "__init__",
)
MOVED = {"actor_critic", "gradient_options", "ribs", "sharding"}  # old names
# Where a package that is not of the standard library may be imported.
EVERYWHERE = {"jax", "numpy", "newton_qd"}
HOMES = {
    "warp": ("physics/", "viewing/"),
    "newton": ("physics/model/build.py", "physics/solver.py", "viewing/"),
}
LEAF_HOMES = ("adapters/", "qd/", "viewing/", "compat/", "cli/")
# each adapter is one door: no other module knows what is behind it
HOMES["brax"] = ("adapters/brax",)
HOMES["gymnasium"] = ("adapters/gymnasium",)
HOMES["torch"] = ("adapters/torch",)
# the gradient doctor's report draws itself, for notebooks, too
HOMES["matplotlib"] = (*LEAF_HOMES, "figure.py")
# Never loaded by `import newton_qd`.
HEAVY = {
    "brax",
    "equinox",
    "flax",
    "gymnasium",
    "matplotlib",
    "mujoco",
    "newton._src.viewer",
    "newton.viewer",
    "qdax",
    "ribs",
    "tensorboardX",
    "torch",
    "tqdm",
}


def modules() -> dict[str, Path]:
    """Dotted name of every module of the package, and its file."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        if parts[-1] == "__init__":
            parts = parts[:-1]
        found[".".join(parts)] = path
    return found


MODULES = modules()


@functools.cache
def imports(name: str) -> tuple[tuple[int, str], ...]:
    """Line and dotted name of everything that a module imports, at any depth."""
    return tuple(_imports(name))


def _imports(name: str) -> Iterator[tuple[int, str]]:
    path = MODULES[name]
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            source = node.module or ""
            if node.level:
                above = package.split(".")[: len(package.split(".")) - node.level + 1]
                source = ".".join([*above, *filter(None, [source])])
            for alias in node.names:
                member = f"{source}.{alias.name}"
                yield node.lineno, member if member in MODULES else source


def layer(name: str) -> str:
    """First name below the package; ``__init__`` for the facade."""
    return name.split(".")[1] if "." in name else "__init__"


def may_import(importer: str, imported: str) -> bool:
    """Whether an arrow between two layers points the right way."""
    if importer == imported:
        return True
    if importer in LEAVES:
        return imported in LAYERS or imported in LEAVES[importer]
    return imported in LAYERS and LAYERS.index(imported) < LAYERS.index(importer)


@pytest.mark.parametrize("name", MODULES)
def test_arrows_point_one_way(name: str) -> None:
    own = layer(name)
    assert own in LAYERS or own in LEAVES, f"give {name} a place in LAYERS or LEAVES"
    wrong = [
        f"{name}:{line} imports {target}"
        for line, target in imports(name)
        if target.split(".")[0] == "newton_qd" and not may_import(own, layer(target))
    ]
    assert not wrong


@pytest.mark.parametrize("name", MODULES)
def test_packages_stay_in_their_home(name: str) -> None:
    path = MODULES[name].relative_to(PACKAGE).as_posix()
    wrong = []
    for line, target in imports(name):
        root = target.split(".")[0]
        if root in EVERYWHERE or root in sys.stdlib_module_names:
            continue
        if not path.startswith(HOMES.get(root, LEAF_HOMES)):
            wrong.append(f"{name}:{line} imports {target}")
        if root == "newton" and ".viewer" in target and not path.startswith("viewing/"):
            wrong.append(f"{name}:{line} imports {target}")
    if path.startswith("physics/kernels/"):
        wrong += [
            f"{name}:{line} imports {target}; kernels do not know JAX"
            for line, target in imports(name)
            if target.split(".")[0] == "jax"
        ]
    assert not wrong


@pytest.mark.parametrize("name", [n for n in MODULES if ".physics.model" in n])
def test_model_does_not_launch(name: str) -> None:
    """What runs before the first step reads nothing of what runs the steps."""
    base = "newton_qd.physics."
    allowed = tuple(base + name for name in ("cache", "model", "reference", "system"))
    wrong = [
        f"{name}:{line} imports {target}"
        for line, target in imports(name)
        if target == "warp" or (target + ".").startswith(base)
        if not target.startswith(allowed)
    ]
    assert not wrong


def test_only_one_file_knows_the_inside_of_warp() -> None:
    private = "warp" + "._src"
    allowed = {"newton_qd/physics/warp_internals.py", "tests/test_warp_internals.py"}
    files = {
        path.relative_to(ROOT).as_posix()
        for folder in ("newton_qd", "tests", "benchmarks", "examples", "docs")
        for path in (ROOT / folder).rglob("*.py")
        if private in path.read_text(encoding="utf-8")
    }
    assert files == allowed


@pytest.mark.parametrize(
    "name", [name for name in MODULES if name.startswith("newton_qd.qd")]
)
def test_rooms_of_qd_have_an_order(name: str) -> None:
    def room(module: str) -> str:
        return [*module.split("."), "__init__"][2]

    if room(name) in MOVED:
        return
    allowed = ROOMS[: ROOMS.index(room(name)) + 1]
    wrong = [
        f"{name}:{line} imports {target}"
        for line, target in imports(name)
        if target.startswith("newton_qd.qd") and room(target) not in allowed
    ]
    assert not wrong


def test_no_import_cycles() -> None:
    graph = {
        name: {target for _, target in imports(name) if target in MODULES} - {name}
        for name in MODULES
    }
    finished: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, f"import cycle: {' -> '.join([*path, name])}"
        if name not in finished:
            for target in sorted(graph[name]):
                visit(target, (*path, name))
            finished.add(name)

    for name in graph:
        visit(name, ())


def test_import_is_light(tmp_path: Path) -> None:
    code = "import sys, newton_qd, json; print(json.dumps(sorted(sys.modules)))"
    cache = tmp_path / "kernels"
    cache.mkdir()
    result = run_python(
        code,
        tmp_path,
        PYTHONPATH=str(TESTED),
        WARP_CACHE_PATH=str(cache),
    )
    assert result.returncode == 0, result.stderr
    # One line: nothing greets the user, Warp's start-up banner included.
    assert result.stdout.count("\n") == 1, result.stdout
    assert not HEAVY.intersection(json.loads(result.stdout))
    assert not list(cache.rglob("*")), "importing compiled or loaded kernels"


@pytest.mark.parametrize("init", sorted(PACKAGE.rglob("__init__.py")))
def test_no_name_is_hidden_by_a_submodule(init: Path) -> None:
    """Importing a submodule sets its name in the package, over a lazy one."""
    homes = re.search(r"^_HOME.*?^}", init.read_text(encoding="utf-8"), re.M | re.S)
    names = re.findall(r'^    "(\w+)":', homes[0] if homes else "", re.M)
    assert not [name for name in names if (init.parent / f"{name}.py").exists()]


def test_facade() -> None:
    names = {
        "Env",
        "State",
        "check",
        "create",
        "create_fn",
        "register",
        "registered_envs",
    }
    assert names <= set(newton_qd.__all__)
    assert all(hasattr(newton_qd, name) for name in newton_qd.__all__)


@pytest.mark.parametrize("name", MUTATIONS)
def test_places_that_mutate_breaks_are_there(name: str) -> None:
    """Three of them had moved to other files, so ``mutate.py`` stopped at them."""
    mutation = MUTATIONS[name]
    text = (PACKAGE / mutation.file).read_text(encoding="utf-8")
    assert text.count(mutation.before) == 1
