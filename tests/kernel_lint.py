"""The rules of the kernels, checked on their syntax tree.

``newton_qd/physics/kernels/__init__.py`` says what Warp's adjoint needs. :func:`lint`
finds what breaks it; ``test_kernel_lint.py`` has an example that breaks each rule.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping

from kernel_flow import Flow
from kernel_program import ADJOINTS, PLAIN, STRUCTS, Function, Program

# Warp unrolls loops of as many turns; then every turn has its own variables.
UNROLLED = 16
OPERATORS = {
    "add": (ast.Add,),
    "sub": (ast.Sub,),
    "mul": (ast.Mult,),
    "div": (ast.Div,),
    "neg": (ast.USub,),
}
# Functions whose adjoint does not read their arguments, for those that are packs.
LINEAR = ("add_diagonal", "component", "neg", "rigid", "transpose", "vector")

Problem = tuple[str, int, str]


def lint(sources: Mapping[str, str]) -> list[str]:
    """Finds what breaks a rule.

    Args:
        sources: Text of each file of the kernels, by its name without the ending.

    Returns:
        ``"file:line: rule: what"`` of each problem.
    """
    program = Program(sources)
    problems = [*program.problems, *Flow(program).problems]
    for function in program.functions.values():
        for line, text in _function(program, function):
            problems.append((function.file, line, text))
    for file, tree in program.trees.items():
        problems += [(file, line, text) for line, text in _operators(tree)]
    return [f"{file}:{line}: {text}" for file, line, text in sorted(set(problems))]


def _function(program: Program, function: Function) -> Iterator[tuple[int, str]]:
    yield from _fields(program, function)
    yield from _calls(program, function)
    yield from _documented(program, function)
    if function.file not in PLAIN:
        yield from _arrays(function)
    if function.kind == "grad":
        yield from _adjoint(program, function)
    if function.kind == "stage":
        for node in ast.walk(function.node):
            if isinstance(node, ast.Return) and node.value is not None:
                yield node.lineno, "stage: it is not repeated, so it returns nothing"
    if function.name in program.differentiated:
        yield from _differentiated(function)


def _fields(program: Program, function: Function) -> Iterator[tuple[int, str]]:
    """Every field that is named is a field of the struct."""
    for node in ast.walk(function.node):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            struct = function.parameters.get(node.value.id, "")
            if struct in STRUCTS and node.attr not in program.structs[struct]:
                yield node.lineno, f"field: {struct} has no {node.attr}"


def _calls(program: Program, function: Function) -> Iterator[tuple[int, str]]:
    """Calls have as many arguments as parameters; stages stand alone; syncs say who."""
    alone = {
        id(node.value) for node in ast.walk(function.node) if isinstance(node, ast.Expr)
    }
    if not function.parameters:
        yield function.node.lineno, "argument: without one it has no adjoint"
    for name, call in function.calls():
        if name == "sync" and [ast.unparse(a) for a in call.args] not in (
            ["lane"],
            ["0"],
        ):
            yield call.lineno, "argument: sync takes the lane"
        called = program.functions.get(name)
        if called is None:
            continue
        if len(call.args) != len(called.parameters) or call.keywords:
            count = len(called.parameters)
            yield call.lineno, f"argument: {name} takes {count}, {len(call.args)} given"
        if called.kind == "stage" and id(call) not in alone:
            yield call.lineno, f"stage: {name} is not repeated, so it has no result"


def _arrays(function: Function) -> Iterator[tuple[int, str]]:
    """Arrays are read and written by the functions of cpp/memory, without atomics."""
    for node in ast.walk(ast.Module(function.body, [])):
        if isinstance(node, ast.Subscript):
            yield node.lineno, "array: elements are loaded and stored by cpp/memory"
        if isinstance(node, ast.Attribute) and node.attr.startswith("atomic_"):
            yield node.lineno, "array: the order of atomic sums is not fixed"


def _adjoint(program: Program, function: Function) -> Iterator[tuple[int, str]]:
    """An adjoint by hand takes what its function takes, and then its results."""
    of = program.functions.get(function.of)
    taken = list(function.parameters.items())
    if of is None or taken[: len(of.parameters)] != list(of.parameters.items()):
        yield function.node.lineno, f"adjoint: {function.of} has other parameters"
    elif any(not p.startswith("adj_ret") for p, _ in taken[len(of.parameters) :]):
        yield function.node.lineno, "adjoint: after the parameters come adj_ret"


def _differentiated(function: Function) -> Iterator[tuple[int, str]]:
    """What Warp makes the adjoint of: marked if it stores, and loops only add up."""
    if function.kind == "func" and function.stores():
        text = "stage: it stores, and has no adjoint by hand"
        yield function.node.lineno, text
    if function.kind == "plain":
        yield function.node.lineno, "plain: it has no adjoint, and needs one here"
    for name, call in function.calls():
        if name in ADJOINTS:
            yield call.lineno, f"adjoint: {name} is for adjoints by hand"
    known = set(function.parameters)
    yield from _loops(function.body, known, function.body)


def _loops(
    body: list[ast.stmt], known: set[str], whole: list[ast.stmt]
) -> Iterator[tuple[int, str]]:
    for node in body:
        if isinstance(node, ast.While):
            yield node.lineno, "loop: a while has no adjoint"
        if isinstance(node, ast.For) and not _is_unrolled(node):
            carried = known & _assigned(node.body) & _exposed(node.body)
            yield from _sums(node, carried)
            yield from _used_after(node, carried, whole)
        for part in ("body", "orelse"):
            yield from _loops(getattr(node, part, []), set(known), whole)
        known |= _assigned([node])


def _is_unrolled(loop: ast.For) -> bool:
    """Whether the number of turns is a constant, or a name in capitals, and small."""
    bounds = loop.iter.args if isinstance(loop.iter, ast.Call) else []
    if len(bounds) != 1:
        return False
    if isinstance(bounds[0], ast.Constant):
        return int(str(bounds[0].value)) <= UNROLLED
    return isinstance(bounds[0], ast.Name) and bounds[0].id.isupper()


def _assigned(body: list[ast.stmt]) -> set[str]:
    return {
        node.id
        for node in ast.walk(ast.Module(body, []))
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
    }


def _read(node: ast.AST) -> set[str]:
    return {
        child.id
        for child in ast.walk(node)
        if isinstance(child, ast.Name) and isinstance(child.ctx, ast.Load)
    }


def _exposed(body: list[ast.stmt]) -> set[str]:
    """Names that are read before a statement of the body has set them."""
    found: set[str] = set()
    known: set[str] = set()
    for node in body:
        simple = isinstance(node, ast.Assign | ast.AugAssign | ast.Expr | ast.Return)
        parts = (
            [node] if simple else [getattr(node, "test", getattr(node, "iter", node))]
        )
        found |= set().union(*(_read(part) for part in parts)) - known
        if isinstance(node, ast.AugAssign):
            found |= {ast.unparse(node.target)} - known
        if simple:
            known |= _assigned([node])
        else:
            inner = _exposed(getattr(node, "body", []))
            inner |= _exposed(getattr(node, "orelse", []))
            found |= inner - known - _assigned([getattr(node, "target", ast.Pass())])
    return found


def _sums(loop: ast.For, carried: set[str]) -> Iterator[tuple[int, str]]:
    """Variables from before a loop get terms added, and nothing in it reads them."""
    for node in ast.walk(ast.Module(loop.body, [])):
        if isinstance(node, ast.Assign):
            name = ast.unparse(node.targets[0])
            value = node.value
            if name in carried and isinstance(value, ast.BinOp):
                added = isinstance(value.op, ast.Add | ast.Sub)
                if added and ast.unparse(value.left) == name:
                    value = value.right
            wrong = carried & _read(value)
            if name in carried and value is node.value:
                wrong.add(name)
        elif isinstance(node, ast.AugAssign):
            name = ast.unparse(node.target)
            wrong = carried & _read(node.value)
            if name in carried and not isinstance(node.op, ast.Add | ast.Sub):
                wrong.add(name)
        elif isinstance(node, ast.Expr | ast.Return | ast.If | ast.For):
            head = getattr(node, "test", getattr(node, "iter", None))
            wrong = carried & _read(head if head is not None else node)
        else:
            continue
        for name in sorted(wrong):
            yield node.lineno, f"loop: {name} may only get terms added to it"


def _used_after(
    loop: ast.For, carried: set[str], whole: list[ast.stmt]
) -> Iterator[tuple[int, str]]:
    """After a loop a sum is only stored; what is computed of it would be wrong."""
    for statement in ast.walk(ast.Module(whole, [])):
        line = getattr(statement, "lineno", 0)
        if not isinstance(statement, ast.stmt) or line <= (loop.end_lineno or 0):
            continue
        if isinstance(statement, ast.For | ast.If | ast.While):
            continue
        for name in sorted(carried & _nonlinear(statement)):
            yield line, f"loop: {name} is a sum, and may only be stored"


def _nonlinear(node: ast.AST) -> set[str]:
    """Names whose value the adjoint of a statement needs."""
    if isinstance(node, ast.Call):
        name = ast.unparse(node.func)
        inner = [_nonlinear(argument) for argument in node.args]
        if name in ("store", *LINEAR):
            return set().union(*inner)
        return set().union(*(_read(argument) for argument in node.args))
    if isinstance(node, ast.BinOp) and not isinstance(node.op, ast.Add | ast.Sub):
        return _read(node)
    parts = (_nonlinear(child) for child in ast.iter_child_nodes(node))
    return set().union(*parts)


def _operators(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Imported operators are used: ruff takes every one of them for unused."""
    used = {
        type(node.op)
        for node in ast.walk(tree)
        if isinstance(node, ast.BinOp | ast.UnaryOp | ast.AugAssign)
    }
    called = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    for node in tree.body:
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                kinds = OPERATORS.get(alias.name)
                if kinds and not used & {*kinds} and alias.name not in called:
                    yield node.lineno, f"operator: {alias.name} is not used"


_LISTS = re.compile(r"\b(Reads|Writes): ((?:[\w.]+,\s+)*[\w.]*\w)\.(?=\s|$)")


def documentation(program: Program, function: Function) -> dict[str, frozenset[str]]:
    """What the docstring of a function has to say that it reads and writes."""
    reads, writes = program.accesses(function.name)
    return {
        word: paths for word, paths in (("Reads", reads), ("Writes", writes)) if paths
    }


def _documented(program: Program, function: Function) -> Iterator[tuple[int, str]]:
    """A docstring lists what its function reads and writes, and nothing else."""
    doc = ast.get_docstring(function.node) or ""
    said = {word: frozenset(re.split(r",\s+", n)) for word, n in _LISTS.findall(doc)}
    expected = documentation(program, function)
    for word in ("Reads", "Writes"):
        found, wanted = said.get(word, frozenset()), expected.get(word, frozenset())
        if missing := sorted(wanted - found):
            yield function.node.lineno, f"docs: {word} lacks {', '.join(missing)}"
        if extra := sorted(found - wanted):
            yield function.node.lineno, f"docs: {word} has {', '.join(extra)}"
