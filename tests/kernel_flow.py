"""Which elements the kernels write: not twice in a step, not by two threads.

Every kernel is walked as it runs, function by function. A value knows what it varies
with: the pack and the lane of its thread, and the loops around it. A store whose index
does not vary with a loop writes the same element in each of its turns.
"""

from __future__ import annotations

import ast
import dataclasses
import hashlib

from kernel_program import READS, WRITES, Function, Program

NOTHING: frozenset[str] = frozenset()
PACK, LANE = "pack", "lane"


@dataclasses.dataclass
class Value:
    """What is known of a value.

    Attributes:
        varies: Loops, pack and lane that it may depend on.
        text: Expression of it in terms of the kernel's arguments.
        fields: Fields of a struct.
    """

    varies: frozenset[str] = NOTHING
    text: str = ""
    fields: dict[str, Value] | None = None


def merged(a: Value, b: Value) -> Value:
    """A value that is one of two."""
    if a is b:
        return a
    fields = None
    if a.fields is not None and b.fields is not None:
        both = {**a.fields, **b.fields}
        fields = {
            name: merged(a.fields.get(name, both[name]), b.fields.get(name, both[name]))
            for name in both
        }
    text = a.text if a.text == b.text else f"either({a.text}, {b.text})"
    return Value(a.varies | b.varies, _short(text), fields)


def _short(text: str) -> str:
    """A long text by its hash."""
    return text if len(text) < 300 else hashlib.sha1(text.encode()).hexdigest()


@dataclasses.dataclass
class Frame:
    """One call of a function.

    Attributes:
        function: The function.
        values: What its names hold.
        loops: Loops around, with pack and lane, less those that an ``if`` holds to one
            turn.
        diverged: Whether lanes may be elsewhere.
        written: Where an element was written, on this path.
        exact: Whether an element may be written once only.
        returned: What it returned.
    """

    function: Function
    values: dict[str, Value]
    loops: frozenset[str]
    diverged: bool
    written: dict[tuple[str, str], int]
    exact: bool
    returned: Value | None = None


class Flow:
    """Walks the kernels of a program; ``problems`` are (file, line, text)."""

    def __init__(self, program: Program) -> None:
        """Walks all kernels.

        Args:
            program: The kernels.
        """
        self.program = program
        self.problems: list[tuple[str, int, str]] = []
        for function in program.functions.values():
            if function.kind == "kernel":
                self._kernel(function)

    def _kernel(self, function: Function) -> None:
        names = {
            node.id
            for node in ast.walk(function.node)
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
        }
        loops = frozenset({PACK, *({LANE} & names)})
        values = {name: Value(text=name) for name in function.parameters}
        frame = Frame(function, values, loops, False, {}, function.backward)
        self._statements(function.body, frame)

    def _report(self, frame: Frame, node: ast.AST, text: str) -> None:
        problem = (frame.function.file, getattr(node, "lineno", 0), text)
        if problem not in self.problems:
            self.problems.append(problem)

    # expressions

    def _value(self, node: ast.AST, frame: Frame) -> Value:
        """What is known of an expression; walks into the functions that it calls."""
        if isinstance(node, ast.Name):
            return frame.values.get(node.id, Value(text=node.id))
        if isinstance(node, ast.Attribute):
            base = self._value(node.value, frame)
            if base.fields is not None and node.attr in base.fields:
                return base.fields[node.attr]
            return Value(base.varies, f"{base.text}.{node.attr}")
        if isinstance(node, ast.Call):
            return self._call(node, frame)
        parts = [
            (child, self._value(child, frame))
            for child in ast.iter_child_nodes(node)
            if isinstance(child, ast.expr)
        ]
        varies = NOTHING.union(*(value.varies for _, value in parts))
        operator = type(getattr(node, "op", node)).__name__
        inner = ", ".join(value.text for _, value in parts)
        text = ast.unparse(node) if not parts else f"{operator}({inner})"
        return Value(varies, _short(text))

    def _call(self, node: ast.Call, frame: Frame) -> Value:
        name = ast.unparse(node.func)
        given = [self._value(argument, frame) for argument in node.args]
        varies = NOTHING.union(*(value.varies for value in given))
        text = _short(f"{name}({', '.join(value.text for value in given)})")
        if name == "wp.tid":
            return Value(frozenset({PACK}), "tid")
        if name == "sync" and frame.diverged:
            self._report(node=node, frame=frame, text=SYNC)
        if name in WRITES:
            self._store(node, given, frame)
        if name in self.program.structs and not node.args:
            return Value(NOTHING, text, {})
        called = self.program.functions.get(name)
        if called is None or name in READS:
            return Value(varies, text)
        own = self.program.adjoints.get(name)
        result = self._run(called, given, frame, exact=frame.exact and own is None)
        if own is not None and frame.exact:
            self._run(own, given, frame, exact=False)
        return result or Value(varies, text)

    def _run(
        self, function: Function, given: list[Value], frame: Frame, exact: bool
    ) -> Value | None:
        values = dict(zip(function.parameters, given, strict=False))
        written = frame.written if exact else {}
        inner = Frame(function, values, frame.loops, frame.diverged, written, exact)
        self._statements(function.body, inner)
        return inner.returned

    def _store(self, node: ast.Call, given: list[Value], frame: Frame) -> None:
        array, index = given[0], given[1]
        threads = {PACK, LANE}
        # the arrays of the scratch begin in the pack's own memory
        for loop in sorted(frame.loops - index.varies - (array.varies & {PACK})):
            if loop in threads:
                self._report(frame, node, RACE.format(ast.unparse(node.args[0]), loop))
            elif frame.exact:
                name = loop.split("@")[0]
                text = AGAIN.format(ast.unparse(node.args[0]), name)
                self._report(frame, node, text)
        key = (array.text, index.text)
        if frame.exact and key in frame.written:
            text = TWICE.format(ast.unparse(node.args[0]), frame.written[key])
            self._report(frame, node, text)
        frame.written[key] = node.lineno

    # statements

    def _statements(self, body: list[ast.stmt], frame: Frame) -> None:
        for node in body:
            if isinstance(node, ast.Assign):
                value = self._value(node.value, frame)
                for target in node.targets:
                    self._assign(target, value, frame)
            elif isinstance(node, ast.AugAssign):
                value = self._value(
                    ast.BinOp(_loaded(node.target), node.op, node.value), frame
                )
                self._assign(node.target, value, frame)
            elif isinstance(node, ast.If):
                self._branch(node, frame)
            elif isinstance(node, ast.For | ast.While):
                self._loop(node, frame)
            elif isinstance(node, ast.Return) and node.value is not None:
                value = self._value(node.value, frame)
                old = frame.returned
                frame.returned = value if old is None else merged(old, value)
            elif isinstance(node, ast.Expr):
                self._value(node.value, frame)

    def _assign(self, target: ast.expr, value: Value, frame: Frame) -> None:
        if isinstance(target, ast.Tuple):
            for n, part in enumerate(target.elts):
                self._assign(part, Value(value.varies, f"{value.text}[{n}]"), frame)
        elif isinstance(target, ast.Attribute):
            base = self._value(target.value, frame)
            if base.fields is not None:
                base.fields[target.attr] = value
        elif isinstance(target, ast.Name):
            if target.id == LANE and frame.function.kind == "kernel":
                value = Value(frozenset({LANE}), LANE)
            frame.values[target.id] = value

    def _branch(self, node: ast.If, frame: Frame) -> None:
        varies = self._value(node.test, frame).varies
        held = self._held(node.test, frame)
        diverged = frame.diverged or LANE in varies
        ends = []
        for body, loops in (
            (node.body, frame.loops - held),
            (node.orelse, frame.loops),
        ):
            inner = dataclasses.replace(
                frame,
                values=dict(frame.values),
                loops=loops,
                diverged=diverged,
                written=dict(frame.written),
            )
            self._statements(body, inner)
            frame.returned = inner.returned
            ends.append(inner)
        one, other = (end.values for end in ends)
        for name in one.keys() | other.keys():
            a, b = one.get(name), other.get(name)
            frame.values[name] = merged(a, b) if a and b else (a or b or Value())
        for end in ends:
            frame.written.update(end.written)

    def _held(self, test: ast.expr, frame: Frame) -> frozenset[str]:
        """Loops that a test holds to one turn: one side varies with them alone."""
        if not (isinstance(test, ast.Compare) and isinstance(test.ops[0], ast.Eq)):
            return NOTHING
        a = self._value(test.left, frame).varies & frame.loops
        b = self._value(test.comparators[0], frame).varies & frame.loops
        return a | b if not (a and b) else NOTHING

    def _loop(self, node: ast.For | ast.While, frame: Frame) -> None:
        if isinstance(node, ast.For):
            name = ast.unparse(node.target)
            bounds = self._value(node.iter, frame)
        else:
            name, bounds = "while", self._value(node.test, frame)
        loop = f"{name}@{frame.function.name}:{node.lineno}"
        turn = Value(bounds.varies | {loop}, f"each({bounds.text})")
        if isinstance(node, ast.For):
            frame.values[name] = turn
        else:
            for child in ast.walk(node):
                if isinstance(child, ast.Name) and isinstance(child.ctx, ast.Store):
                    frame.values[child.id] = turn
        inner = dataclasses.replace(
            frame,
            loops=frame.loops | {loop},
            diverged=frame.diverged or LANE in bounds.varies,
        )
        self._statements(node.body, inner)
        frame.returned = inner.returned


def _loaded(target: ast.expr) -> ast.expr:
    return ast.parse(ast.unparse(target), mode="eval").body


SYNC = "sync: not all lanes come here"
RACE = "race: {0} is written by every {1} of threads at this index"
AGAIN = "once: {0} is written in every turn of the loop over {1} at this index"
TWICE = "once: {0} was written at this index in line {1}"
