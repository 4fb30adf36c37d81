"""The kernels keep the rules of their adjoint, and every rule finds what breaks it."""

from __future__ import annotations

import ast
import textwrap
from pathlib import Path

import pytest
from kernel_lint import lint
from kernel_program import Program

import newton_qd
from newton_qd.physics.precision import SHARED

KERNELS = Path(newton_qd.__file__).parent / "physics" / "kernels"

# A step of two stages in a loop over substeps that keeps every rule.
GOOD = {
    "structs": """
        @wp.struct
        class Model:
            h: scalar
            substeps: int
            nv: int
            nb: int
            child: wp.array[int]

        @wp.struct
        class Scratch:
            q: wp.array[real]
            v: wp.array[real]
            total: wp.array[real]
            fault: wp.array[real]

        @wp.struct
        class Offsets:
            v: int
            v_next: int
            body: int
            report: int

        @wp.func
        def offsets_at(m: Model, slot: int, s: int):
            '''Offsets of a substep. Reads: m.substeps, m.nv, m.nb.'''
            r = Offsets()
            r.v = (slot * m.substeps + s) * m.nv
            r.v_next = r.v + m.nv
            r.body = (slot * m.substeps + s) * m.nb
            r.report = slot * m.nb
            return r
        """,
    "step": """
        from .cpp.operators import add, mul  # noqa: F401

        @wp.func
        def load_world(m: Model, sc: Scratch, g: Scratch, slot: int, lane: int):
            '''Start. Writes: sc.v.'''
            if lane == 0:
                store(sc.v, slot, real())
            sync(lane)

        @wp.func_grad(load_world)
        def adj_load_world(m: Model, sc: Scratch, g: Scratch, slot: int, lane: int):
            '''End. Writes: g.v.'''
            if lane == 0:
                store(g.v, slot, real())

        @plain
        def answer(sc: Scratch, slot: int, lane: int):
            '''Stored twice. Reads: sc.q. Writes: sc.fault.'''
            if lane == 0:
                store(sc.fault, slot, load(sc.q, slot))
                store(sc.fault, slot, load(sc.q, slot))

        @wp.func_grad(answer)
        def adj_answer(sc: Scratch, slot: int, lane: int):
            '''Its adjoint. Reads: g.fault. Writes: g.fault, g.q.'''
            if lane == 0:
                add_adjoint(sc.q, slot, load_adjoint(sc.fault, slot))
                store_adjoint(sc.fault, slot, real())

        @stage
        def gather(m: Model, sc: Scratch, offsets: Offsets, i: int):
            '''Sum over children. Reads: sc.v, m.child. Writes: sc.total.'''
            total = real()
            for j in range(load(m.child, i), load(m.child, i + 1)):
                total = total + load(sc.v, offsets.v + j)
            store(sc.total, offsets.body + i, total + load(sc.v, offsets.v))

        @stage
        def move(m: Model, sc: Scratch, offsets: Offsets, k: int):
            '''New velocity. Reads: m.h, sc.v, sc.total. Writes: sc.v.'''
            change = m.h * load(sc.total, offsets.body)
            store(sc.v, offsets.v_next + k, load(sc.v, offsets.v + k) + change)

        @stage
        def finish(sc: Scratch, offsets: Offsets, i: int):
            '''Record. Reads: sc.total. Writes: sc.fault.'''
            store(sc.fault, offsets.report + i, load(sc.total, offsets.body + i))

        @wp.kernel
        def step_backward(m: Model, lanes: int, sc: Scratch, g: Scratch):
            '''A step.'''
            tid = wp.tid()
            slot = tid // lanes
            lane = tid - slot * lanes
            load_world(m, sc, g, slot, lane)
            answer(sc, slot, lane)
            sync(lane)
            for s in range(m.substeps):
                offsets = offsets_at(m, slot, s)
                for i in range(lane, m.nb, lanes):
                    gather(m, sc, offsets, i)
                sync(lane)
                for k in range(lane, m.nv, lanes):
                    move(m, sc, offsets, k)
                if s == m.substeps - 1:
                    for i in range(lane, m.nb, lanes):
                        finish(sc, offsets, i)
                sync(lane)
        """,
}

SUM = "total = total + load(sc.v, offsets.v + j)"
STORED = "store(sc.total, offsets.body + i, total + load(sc.v, offsets.v))"

# rule: what is said, and the change that breaks it
BROKEN = {
    "stored twice": (
        "once: sc.total was written at this index in line",
        STORED,
        f"{STORED}; store(sc.total, offsets.body + i, real())",
    ),
    "stored by two stages": (
        "once: sc.v was written at this index",
        "move(m, sc, offsets, k)",
        "move(m, sc, offsets, k); move(m, sc, offsets, k)",
    ),
    "stored in every substep": (
        "once: sc.fault is written in every turn of the loop over s",
        "if s == m.substeps - 1:",
        "if s <= m.substeps - 1:",
    ),
    "stored in every turn": (
        "once: sc.total is written in every turn of the loop over j",
        SUM,
        f"{SUM}; store(sc.total, offsets.body + i, total)",
    ),
    "offsets that substeps share": (
        "once: sc.total is written in every turn of the loop over s",
        "r.body = (slot * m.substeps + s) * m.nb",
        "r.body = slot * m.nb",
    ),
    "stored by every lane": (
        "race: sc.total is written by every lane",
        "for i in range(lane, m.nb, lanes):\n            gather",
        "for i in range(m.nb):\n            gather",
    ),
    "stored by every lane, by hand": (
        "race: g.v is written by every lane",
        "if lane == 0:\n        store(g.v",
        "if lane >= 0:\n        store(g.v",
    ),
    "stored by every pack": (
        "race: sc.v is written by every pack",
        "store(sc.v, slot, real())",
        "store(sc.v, 0, real())",
    ),
    "sync in a branch": (
        "sync: not all lanes come here",
        "store(sc.v, slot, real())\n",
        "store(sc.v, slot, real())\n        sync(lane)\n",
    ),
    "sync in a loop of some lanes": (
        "sync: not all lanes come here",
        "gather(m, sc, offsets, i)\n",
        "gather(m, sc, offsets, i)\n            sync(lane)\n",
    ),
    "sync without the lane": ("argument: sync takes the lane", "sync(lane)", "sync(m)"),
    "a function without an argument": (
        "argument: without one it has no adjoint",
        "@wp.kernel",
        "@wp.func\ndef rest():\n    '''Nothing.'''\n\n@wp.kernel",
    ),
    "too few arguments": (
        "argument: finish takes 3, 2 given",
        "finish(sc, offsets, i)",
        "finish(sc, offsets)",
    ),
    "a stage that returns": (
        "stage: it is not repeated, so it returns nothing",
        STORED,
        f"{STORED}; return total",
    ),
    "a stage that is used": (
        "stage: gather is not repeated, so it has no result",
        "gather(m, sc, offsets, i)\n",
        "got = gather(m, sc, offsets, i)\n",
    ),
    "stores, and is no stage": (
        "stage: it stores, and has no adjoint by hand",
        "@stage\ndef move",
        "@wp.func\ndef move",
    ),
    "no adjoint by hand": (
        "stage: it stores, and has no adjoint by hand",
        "@wp.func_grad(load_world)",
        "@wp.func_grad(gather)",
    ),
    "other parameters in the adjoint": (
        "adjoint: load_world has other parameters",
        "def adj_load_world(m: Model, sc: Scratch, g: Scratch, slot: int, lane: int)",
        "def adj_load_world(m: Model, g: Scratch, slot: int, lane: int)",
    ),
    "a product in a loop": (
        "loop: total may only get terms added to it",
        SUM,
        "total = total * load(sc.v, offsets.v + j)",
    ),
    "a sum that is read in its loop": (
        "loop: total may only get terms added to it",
        SUM,
        "total = total + total * load(sc.v, offsets.v + j)",
    ),
    "a sum that decides": (
        "loop: total may only get terms added to it",
        SUM,
        f"if total > 0.0:\n            {SUM}",
    ),
    "a sum that is computed with": (
        "loop: total is a sum, and may only be stored",
        STORED,
        "store(sc.total, offsets.body + i, m.h * total)",
    ),
    "a while": (
        "loop: a while has no adjoint",
        "for j in range(load(m.child, i), load(m.child, i + 1)):",
        "j = load(m.child, i)\n    while j > 0:",
    ),
    "an element without load": (
        "array: elements are loaded and stored by cpp/memory",
        "load(sc.total, offsets.body + i))",
        "sc.total[offsets.body + i])",
    ),
    "a sum in an array": (
        "array: elements are loaded and stored by cpp/memory",
        STORED,
        f"{STORED}; sc.v[offsets.v] += total",
    ),
    "an atomic sum": (
        "array: the order of atomic sums is not fixed",
        STORED,
        f"{STORED}; wp.atomic_add(sc.v, i, total)",
    ),
    "an unknown field": (
        "field: Offsets has no bodies",
        "offsets.body +",
        "offsets.bodies +",
    ),
    "a plain function that has no adjoint": (
        "plain: it has no adjoint, and needs one here",
        "@wp.func_grad(answer)",
        "@wp.func_grad(load_world)",
    ),
    "an adjoint by hand in a stage": (
        "adjoint: load_adjoint is for adjoints by hand",
        "load(sc.total, offsets.body + i))",
        "load_adjoint(sc.total, offsets.body + i))",
    ),
    "an adjoint by two lanes": (
        "race: sc.q is written by every lane of threads at this index",
        "if lane == 0:\n        add_adjoint",
        "if lane >= 0:\n        add_adjoint",
    ),
    "adjoints that are not said": (
        "docs: Writes lacks g.q",
        "Writes: g.fault, g.q.",
        "Writes: g.fault.",
    ),
    "C++ elsewhere": (
        "native: C++ is written in cpp/ only",
        "@wp.kernel",
        "@wp.func_native('return a;')\ndef same(a: real): ...\n\n@wp.kernel",
    ),
    "an operator that is not used": (
        "operator: div is not used",
        "import add, mul",
        "import add, div, mul",
    ),
    "two functions of one name": (
        "name: move is also in step",
        "def finish(",
        "def move(",
    ),
    "reads that are not said": ("docs: Reads lacks m.child", "sc.v, m.child.", "sc.v."),
    "reads that are not there": (
        "docs: Reads has sc.q",
        "Record. Reads: sc.total.",
        "Record. Reads: sc.total, sc.q.",
    ),
    "writes that are not said": (
        "docs: Writes lacks sc.fault",
        " Writes: sc.fault.",
        "",
    ),
}


def dedented(sources: dict[str, str]) -> dict[str, str]:
    """The files as they would be on disk."""
    return {name: textwrap.dedent(text) for name, text in sources.items()}


def test_the_kernels_keep_the_rules() -> None:
    files = sorted(KERNELS.glob("*.py"))
    assert lint({path.stem: path.read_text() for path in files}) == []


def test_shared_modules_depend_neither_on_boxes_nor_on_pairs() -> None:
    for path in (path for path in KERNELS.rglob("*.py") if path.stem != "__init__"):
        own = path.relative_to(KERNELS).with_suffix("").parts
        if own[0] not in SHARED:
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ImportFrom) or node.level != len(own):
                continue
            names = {alias.name for alias in node.names}
            if node.module is None:
                assert not names & {"boxes", "pairs"}, path
            else:
                assert node.module.split(".")[0] in SHARED, (path, node.module)


def test_the_kernels_are_seen() -> None:
    """The rules are checked on what they are for: every stage is differentiated."""
    program = Program({path.stem: path.read_text() for path in KERNELS.glob("*.py")})
    stages = {f.name for f in program.functions.values() if f.kind == "stage"}
    assert len(stages) > 20
    assert stages <= program.differentiated
    assert {"load_world", "detect_fault", "seed_world"} <= program.adjoints.keys()


def test_a_good_example_passes() -> None:
    assert lint(dedented(GOOD)) == []


@pytest.mark.parametrize("rule", BROKEN)
def test_a_rule_finds_what_breaks_it(rule: str) -> None:
    said, before, after = BROKEN[rule]
    sources = dedented(GOOD)
    assert any(before in text for text in sources.values())
    broken = {name: text.replace(before, after) for name, text in sources.items()}
    assert any(said in problem for problem in lint(broken)), lint(broken)
