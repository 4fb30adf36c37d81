"""Docstrings of public functions: those that check arguments say what they raise.

Ruff's rule DOC501 finds a ``raise`` in the function itself. This test also finds calls
of checks, which raise in another function.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import newton_qd

PACKAGE = Path(newton_qd.__file__).parent
# functions of newton_qd.checks that raise nothing
HELPERS = {"Fact", "is_array", "is_integer", "is_number", "listed", "message", "shown"}
CHECKS = ("check_", "checked_", "require_", "refuse_", "_check", "_require")
CONSTRUCTORS = {"__init__", "__post_init__"}


def _own(function: ast.FunctionDef) -> Iterator[ast.AST]:
    """Yields the nodes of a function without those of functions inside it."""
    pending: list[ast.AST] = list(function.body)
    while pending:
        node = pending.pop()
        yield node
        if not isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Lambda):
            pending += ast.iter_child_nodes(node)


def _raises(function: ast.FunctionDef, imported: set[str]) -> bool:
    """Returns whether a function raises, or calls a check."""
    for node in _own(function):
        if isinstance(node, ast.Raise) and node.exc is not None:
            return True
        if isinstance(node, ast.Call):
            room, _, name = ast.unparse(node.func).rpartition(".")
            known = room == "checks" or (not room and name in imported)
            if name not in HELPERS and (known or name.startswith(CHECKS)):
                return True
    return False


def _silent(tree: ast.Module) -> list[str]:
    """Returns the public functions that raise and have no ``Raises:`` section."""
    imported = {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module == "newton_qd.checks"
        for alias in node.names
    }
    found = []

    def visit(scope: ast.Module | ast.ClassDef, prefix: str) -> None:
        for node in scope.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                visit(node, f"{prefix}{node.name}.")
            if not isinstance(node, ast.FunctionDef):
                continue
            special = node.name in CONSTRUCTORS
            if node.name.startswith("_") and not special:
                continue
            text = ast.get_docstring(node) or ""
            if special and isinstance(scope, ast.ClassDef):
                text += ast.get_docstring(scope) or ""
            if _raises(node, imported) and "Raises:\n" not in text:
                found.append(prefix + node.name)

    visit(tree, "")
    return found


def test_public_functions_that_check_arguments_say_what_they_raise():
    found = {
        str(path.relative_to(PACKAGE)): _silent(ast.parse(path.read_text()))
        for path in PACKAGE.rglob("*.py")
    }
    assert len(found) > 100
    assert {path: names for path, names in found.items() if names} == {}


def test_a_function_without_a_section_is_found():
    source = '''
from newton_qd.checks import integer, message

def raises():
    """Text."""
    raise ValueError(message("a", 1, "2"))

def checks_an_argument(a):
    """Text."""
    integer("a", a)

def tells(a):
    """Text.

    Raises:
        ValueError: Always.
    """
    integer("a", a)

def only_names():
    """Text."""
    return message("a", 1, "2")
'''
    assert _silent(ast.parse(source)) == ["raises", "checks_an_argument"]
