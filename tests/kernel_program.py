"""The kernels as a syntax tree: functions, structs, what each reads and writes.

What the rules of :mod:`kernel_lint` are checked on. Nothing is imported or compiled.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import re
from collections.abc import Iterator, Mapping

# Files whose kernels are not for packs of worlds and have no adjoint.
PLAIN = ("episodes", "conventions")
# Functions of cpp/ that reach memory: which argument is the array, which the index.
READS = ("load", "constant", "read_input", "load_adjoint")
WRITES = ("store", "write_output", "store_adjoint", "add_adjoint")
# Those that reach the adjoint of an array.
ADJOINTS = ("load_adjoint", "store_adjoint", "add_adjoint")
# What a parameter's struct is called in documentation.
STRUCTS = ("Model", "Scratch", "Offsets", "Pack")


@dataclasses.dataclass(frozen=True)
class Function:
    """A function of the kernels.

    Attributes:
        file: Name of its file, without the ending.
        node: Its syntax tree.
        kind: ``"stage"``, ``"func"``, ``"plain"``, ``"grad"`` or ``"kernel"``.
        of: What a ``"grad"`` is the adjoint of.
        backward: Whether a kernel has an adjoint.
    """

    file: str
    node: ast.FunctionDef
    kind: str
    of: str = ""
    backward: bool = False

    @property
    def name(self) -> str:
        """Its name."""
        return self.node.name

    @functools.cached_property
    def parameters(self) -> dict[str, str]:
        """Annotation of each parameter."""
        return {
            a.arg: ast.unparse(a.annotation) if a.annotation else ""
            for a in self.node.args.args
        }

    @functools.cached_property
    def body(self) -> list[ast.stmt]:
        """Its statements after the docstring."""
        return self.node.body[ast.get_docstring(self.node) is not None :]

    def calls(self) -> Iterator[tuple[str, ast.Call]]:
        """Name and node of every call of a plain name."""
        for node in ast.walk(ast.Module(self.body, [])):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                yield node.func.id, node

    def stores(self) -> bool:
        """Whether it writes to an array itself."""
        return any(name in WRITES for name, _ in self.calls())


def _decorator(node: ast.expr) -> tuple[str, ast.Call | None]:
    call = node if isinstance(node, ast.Call) else None
    return ast.unparse(call.func if call else node).removeprefix("wp."), call


def _is_false(call: ast.Call | None) -> bool:
    """Whether a decorator says ``enable_backward=False``."""
    return call is not None and any(
        keyword.arg == "enable_backward" and ast.unparse(keyword.value) == "False"
        for keyword in call.keywords
    )


class Program:
    """All functions and structs of some files.

    Attributes:
        trees: Syntax tree of each file.
        functions: Functions by name.
        structs: Type of each field of each struct.
        adjoints: The adjoint by hand of a function, by its name.
        problems: File, line and text of what is wrong with definitions.
    """

    def __init__(self, sources: Mapping[str, str]) -> None:
        """Reads the files.

        Args:
            sources: Text of each file by its name; names below ``cpp`` are left out.
        """
        self.trees = {file: ast.parse(text) for file, text in sources.items()}
        self.functions: dict[str, Function] = {}
        self.structs: dict[str, dict[str, str]] = {}
        self.problems: list[tuple[str, int, str]] = []
        for file, tree in self.trees.items():
            backward = not any(
                isinstance(node, ast.Call)
                and ast.unparse(node.func) == "wp.set_module_options"
                and "'enable_backward': False" in ast.unparse(node)
                for node in ast.walk(tree)
            )
            for node in tree.body:
                self._define(file, node, backward)
        self.adjoints = {f.of: f for f in self.functions.values() if f.of}

    def _define(self, file: str, node: ast.stmt, backward: bool) -> None:
        if isinstance(node, ast.ClassDef):
            self.structs[node.name] = {
                ast.unparse(item.target): ast.unparse(item.annotation)
                for item in node.body
                if isinstance(item, ast.AnnAssign)
            }
        if not isinstance(node, ast.FunctionDef) or not node.decorator_list:
            return
        kind, call = _decorator(node.decorator_list[0])
        if kind == "func_native":
            if file != "__init__":
                text = "C++ is written in cpp/ only"
                self.problems.append((file, node.lineno, f"native: {text}"))
            return
        of = ast.unparse(call.args[0]) if kind == "func_grad" and call else ""
        # a part is replayed or not; for the rules it is a function as others
        kind = "grad" if of else "func" if kind == "part" else kind
        if node.name in self.functions:
            text = f"{node.name} is also in {self.functions[node.name].file}"
            self.problems.append((file, node.lineno, f"name: {text}"))
        backward = kind == "kernel" and backward and not _is_false(call)
        self.functions[node.name] = Function(file, node, kind, of, backward)

    @functools.cached_property
    def differentiated(self) -> set[str]:
        """Functions that Warp makes the adjoint of: those of a backward kernel.

        A function with an adjoint by hand is not, nor what only such functions call.
        """
        found = set()
        waiting = [f.name for f in self.functions.values() if f.backward]
        while waiting:
            name = waiting.pop()
            if name in found or name in self.adjoints:
                continue
            found.add(name)
            calls = self.functions[name].calls()
            waiting += [called for called, _ in calls if called in self.functions]
        return found

    def accesses(self, name: str) -> tuple[frozenset[str], frozenset[str]]:
        """What a function reads and writes.

        Scratch arrays and arrays of the caller count where functions that it calls
        reach them, unless these are stages, plain or have an adjoint by hand; fields of
        the model only where it names them itself. Of a kernel, its arrays count,
        however they are reached.

        Args:
            name: The function.
        """
        function = self.functions[name]
        if function.kind != "kernel":
            return self._accesses(name, "")
        arrays = {p for p, kind in function.parameters.items() if "array" in kind}
        mode = "backward" if function.backward else "forward"
        reads, writes = self._accesses(name, mode)
        return reads & arrays, writes & arrays

    @functools.cache  # noqa: B019
    def _accesses(self, name: str, mode: str) -> tuple[frozenset[str], frozenset[str]]:
        function = self.functions[name]
        reads, writes = _elements(function)
        for called, call in function.calls():
            helper = self.functions.get(called)
            if helper is None:
                continue
            own = self.adjoints.get(called)
            if not mode and (own or helper.kind != "func"):
                continue
            for part in filter(None, (helper, own if mode == "backward" else None)):
                given = [ast.unparse(argument) for argument in call.args]
                names = dict(zip(part.parameters, given, strict=False))
                both = self._accesses(part.name, mode)
                for total, paths in zip((reads, writes), both, strict=True):
                    for path in paths:
                        root, dot, field = path.partition(".")
                        if part.parameters.get(root) != "Model":
                            total.add(names.get(root, root) + dot + field)
        return frozenset(reads), frozenset(writes)


def _elements(function: Function) -> tuple[set[str], set[str]]:
    """What a function reads and writes by itself: fields of the model, and arrays."""
    reads, writes = set(), set()
    models = {p for p, kind in function.parameters.items() if kind == "Model"}
    arrays = {p for p, kind in function.parameters.items() if "array" in kind}
    for node in ast.walk(ast.Module(function.body, [])):
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) in models:
            reads.add(ast.unparse(node))
        if isinstance(node, ast.Subscript) and ast.unparse(node.value) in arrays:
            loaded = isinstance(node.ctx, ast.Load)
            (reads if loaded else writes).add(ast.unparse(node.value))
    for called, call in function.calls():
        if called in (*READS, *WRITES):
            array = ast.unparse(call.args[0])
            if called in ADJOINTS:
                array = re.sub(r"^sc\.", "g.", array)
            (reads if called in READS else writes).add(array)
    return reads, writes
