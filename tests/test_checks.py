"""Checks of arguments, and the one grammar of errors about them."""

from __future__ import annotations

import ast
import itertools
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import newton_qd
from newton_qd import checks
from newton_qd.checks import Fact, message, shown

PACKAGE = Path(newton_qd.__file__).parent
NAN, INF = math.nan, math.inf


class OwnError(ValueError):
    """Raised where a caller names its own class."""


# What is called, what is given, the class of the error, and what is allowed.
Case = tuple[Callable[..., Any], Any, type[Exception], str]


def with_options(check: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    return lambda name, value, **more: check(name, value, **options, **more)


def number(**options: Any) -> Callable[..., Any]:
    return with_options(checks.number, **options)


def integer(**options: Any) -> Callable[..., Any]:
    return with_options(checks.integer, **options)


TEXT = with_options(checks.instance, kinds=str, allowed="text")
CALLED = with_options(checks.function, allowed="a function of x")
SHAPE = with_options(checks.array, shape=(2,), dtype="float32")
ARRAY = "an array of shape (2,), float32"
REFUSED: list[Case] = [
    (checks.number, "1", TypeError, "finite numbers"),
    (checks.number, None, TypeError, "finite numbers"),
    (checks.number, True, TypeError, "finite numbers"),
    (checks.number, 1j, TypeError, "finite numbers"),
    (checks.number, [1.0], TypeError, "finite numbers"),
    (checks.number, NAN, ValueError, "finite numbers"),
    (checks.number, -INF, ValueError, "finite numbers"),
    (checks.number, 10**400, ValueError, "finite numbers"),
    (number(least=0), -0.5, ValueError, "finite numbers from 0"),
    (number(above=0), 0.0, ValueError, "finite numbers above 0"),
    (number(most=3), 4, ValueError, "finite numbers up to 3"),
    (number(below=3), 3, ValueError, "finite numbers below 3"),
    (number(least=0, most=1), 1.5, ValueError, "numbers from 0 to 1"),
    (number(least=0, below=1), 1, ValueError, "numbers from 0, below 1"),
    (number(above=0, most=1), 0, ValueError, "numbers above 0 up to 1"),
    (number(above=0, below=1), 1, ValueError, "numbers above 0, below 1"),
    (number(endless=True), NAN, ValueError, "numbers"),
    (number(endless=True), 10**400, ValueError, "numbers"),
    (number(above=0, endless=True), -INF, ValueError, "numbers above 0"),
    (number(optional=True), "a", TypeError, "None, or finite numbers"),
    (number(least=0, optional=True), -1, ValueError, "None, or finite numbers from 0"),
    (checks.integer, 0, ValueError, "integers from 1 to 2147483647"),
    (checks.integer, 2**31, ValueError, "integers from 1 to 2147483647"),
    (checks.integer, 2.0, ValueError, "integers from 1 to 2147483647"),
    (checks.integer, "2", ValueError, "integers from 1 to 2147483647"),
    (checks.integer, None, ValueError, "integers from 1 to 2147483647"),
    (checks.integer, True, ValueError, "integers from 1 to 2147483647"),
    (integer(most=None), 0, ValueError, "integers from 1"),
    (integer(least=None, most=5), 6, ValueError, "integers up to 5"),
    (integer(least=None, most=None), 1.5, ValueError, "integers"),
    (integer(most=None, optional=True), 0, ValueError, "None, or integers from 1"),
    (checks.interval, 1.0, TypeError, "two numbers, lowest below highest"),
    (checks.interval, (1.0,), TypeError, "two numbers, lowest below highest"),
    (checks.interval, (0, "a"), TypeError, "two numbers, lowest below highest"),
    (checks.interval, (1.0, 1.0), ValueError, "two numbers, lowest below highest"),
    (checks.interval, (NAN, 1.0), ValueError, "two numbers, lowest below highest"),
    (checks.flag, "no", TypeError, "True, False"),
    (checks.flag, None, TypeError, "True, False"),
    (checks.flag, 2, TypeError, "True, False"),
    (checks.flag, 1.0, TypeError, "True, False"),
    (checks.text, "", ValueError, "text that is not empty"),
    (checks.text, 3, ValueError, "text that is not empty"),
    (checks.text, None, ValueError, "text that is not empty"),
    (with_options(checks.text, optional=True), "", ValueError, "None, or text that is"),
    (TEXT, 3, TypeError, "text"),
    (TEXT, None, TypeError, "text"),
    (with_options(TEXT, optional=True), 3, TypeError, "None, or text"),
    (CALLED, 3, TypeError, "a function of x"),
    (CALLED, None, TypeError, "a function of x"),
    (with_options(CALLED, optional=True), 3, TypeError, "None, or a function of x"),
    (SHAPE, [1.0, 2.0], TypeError, ARRAY),
    (SHAPE, 1.0, TypeError, ARRAY),
    (SHAPE, None, TypeError, ARRAY),
    (SHAPE, np.ones(2, np.int32), TypeError, ARRAY),
    (SHAPE, np.ones(2, np.float16), TypeError, ARRAY),
    (SHAPE, np.ones(2, bool), TypeError, ARRAY),
    (SHAPE, np.array([1.0, None]), TypeError, ARRAY),
    (SHAPE, np.array(["1", "2"]), TypeError, ARRAY),
    (SHAPE, jnp.full((2,), 1), TypeError, ARRAY),
    (SHAPE, np.ones(3, np.float32), ValueError, ARRAY),
    (SHAPE, np.ones((2, 2), np.float32), ValueError, f"{ARRAY} (for a batch, use jax"),
    (with_options(SHAPE, scalars=True), "1", TypeError, ARRAY),
    (with_options(SHAPE, scalars=True), True, TypeError, ARRAY),
    (with_options(SHAPE, scalars=True), 1.0, ValueError, ARRAY),
]


@pytest.mark.parametrize("index", range(len(REFUSED)))
def test_refused(index: int) -> None:
    """Each error names the argument, the value and what is allowed."""
    check, value, error, allowed = REFUSED[index]
    with pytest.raises(error) as caught:
        check("width", value)
    assert type(caught.value) is error
    name, got, rest = split(str(caught.value))
    assert name == "width"
    array = checks.is_array(value) or (check is not SHAPE and allowed.startswith(ARRAY))
    assert got == shown(value) or (array and got.startswith("an array of shape"))
    assert rest.startswith(allowed)


def split(text: str) -> tuple[str, str, str]:
    """The three parts of an error."""
    name, mark, rest = text.partition(": got ")
    got, other, allowed = rest.partition("; allowed: ")
    assert mark and other and allowed, text
    return name, got, allowed


ALLOWED: list[tuple[Callable[..., Any], Any]] = [
    (checks.number, 0),
    (checks.number, np.float32(3.4e38)),
    (checks.number, np.int64(3)),
    (number(above=0, endless=True), INF),
    (number(endless=True), np.float32(-np.inf)),
    (number(least=0, most=1), 1),
    (number(optional=True), None),
    (checks.integer, 1),
    (checks.integer, np.int32(2**31 - 1)),
    (integer(most=None), 10**30),
    (integer(least=None, most=None), -5),
    (integer(optional=True), None),
    (checks.interval, (0, 1)),
    (checks.interval, [0.5, np.float32(1)]),
    (checks.interval, np.array([0.0, 1.0])),
    (checks.flag, True),
    (checks.flag, np.bool_(False)),
    (checks.flag, 0),
    (checks.text, "a"),
    (with_options(checks.text, optional=True), None),
    (TEXT, ""),
    (with_options(TEXT, optional=True), None),
    (CALLED, len),
    (with_options(CALLED, optional=True), None),
]


@pytest.mark.parametrize("index", range(len(ALLOWED)))
def test_allowed(index: int) -> None:
    check, value = ALLOWED[index]
    assert check("width", value) is None


@pytest.mark.parametrize(
    ("check", "value"),
    [
        (checks.number, "a"),
        (checks.number, NAN),
        (checks.integer, 0),
        (checks.interval, 1.0),
        (checks.interval, (1, 0)),
        (checks.flag, "no"),
        (checks.text, ""),
        (TEXT, 3),
    ],
)
def test_a_caller_names_its_own_class(check: Callable[..., Any], value: Any) -> None:
    with pytest.raises(OwnError) as caught:
        check("width", value, error=OwnError)
    split(str(caught.value))


def test_arrays_are_strongly_typed() -> None:
    for value in (jnp.ones(2), np.ones(2, np.float32), jnp.full((2,), 1.0)):
        found: Any = checks.array("x", value, (2,), np.float32)
        assert found.dtype == np.float32 and not found.weak_type
    for value in (3, 2.5, np.float32(1), np.ones((), np.float32), jnp.asarray(2)):
        found = checks.array("x", value, (), "float32", scalars=True)
        assert found.dtype == np.float32 and not found.weak_type
    traced = jax.jit(lambda x: checks.array("x", x, (2,), "float32"))(jnp.ones(2))
    assert traced.tolist() == [1.0, 1.0]
    with pytest.raises(ValueError, match=r"^x: got an array of shape \(3,\), float32;"):
        jax.eval_shape(lambda x: checks.array("x", x, (2,), "float32"), jnp.ones(3))


def test_precision(x64: None) -> None:
    assert checks.precision("float64") == np.float64
    assert checks.precision(np.float32) == np.float32
    wrong: Any
    for wrong in ("float16", "foo", 3, int, None):
        with pytest.raises(ValueError, match=r"^dtype: got .*;.*float32, float64"):
            checks.precision(wrong)


def test_precision_without_x64() -> None:
    with jax.enable_x64(False):
        checks.x64(np.dtype(np.float32))
        with pytest.raises(ValueError, match=r"^dtype: got 'float64' while JAX x64 is"):
            checks.precision("float64")


def test_environments_are_known_by_what_they_have() -> None:
    env = newton_qd.create("pointmaze")
    checks.environment(env)
    checks.environment(env, needs="unwrapped")
    for wrong in (None, "ant", 3):
        with pytest.raises(TypeError, match=r"^env: got .*; allowed: an environment"):
            checks.environment(wrong)


class Long:
    def __repr__(self) -> str:
        return "<" + "x" * 500 + ">"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.5, "1.5"),
        ("a", "'a'"),
        (None, "None"),
        (Fact("3 entries"), "3 entries"),
        (np.float32(0.5), repr(np.float32(0.5))),
        (np.zeros((2, 3)), "an array of shape (2, 3), float64"),
        (jnp.zeros(4, np.int32), "an array of shape (4,), int32"),
        (np.float32, "<class 'numpy.float32'>"),
        (list(range(1000)), str(list(range(1000)))[:97] + "... (list)"),
        (Long(), "<" + "x" * 96 + "... (Long)"),
        ("a\nb", r"'a\nb'"),
    ],
)
def test_shown(value: Any, text: str) -> None:
    assert shown(value) == text
    assert message("x", value, "y") == f"x: got {text}; allowed: y"
    assert message("x", value, "y", why="no") == f"x: got {text}, no; allowed: y"


def test_lines_become_one() -> None:
    assert shown({"a": np.arange(3), "b": jnp.zeros(2)}).count("\n") == 0
    assert len(shown([np.zeros((50, 50))] * 9)) < 120


def test_listed() -> None:
    assert checks.listed(["a", 3]) == "a, 3"
    assert checks.listed([]) == "none"
    assert checks.listed((), "nothing") == "nothing"


# The grammar stays: every error about an argument is made by `checks`.
ARGUMENTS = {
    "AssetNotFoundError",
    "ConfigError",
    "GradientsError",
    "NotImplementedError",
    "RobotDescriptionError",
    "TypeError",
    "ValueError",
}
BUILDERS = {"message", "not_simulated", "unsupported"}
# Beginnings of other texts, by file, and why they are no `NAME: got VALUE`.
EXCEPTIONS = {
    "assets.py": {"the URDF files of newton_qd are missing": "about an installation"},
    "physics/reverse_mode.py": {
        "_FORWARD": "JAX's words, and what to use instead",
        "_SECOND": "about a transformation, not a value",
        "there is no derivative of": "about a transformation, not a value",
    },
    "physics/model/xml_reader.py": {
        "{self.path}, line {error.lineno}": "about the text of a file, not a value",
        "{self.path}, line 1": "about the text of a file, not a value",
    },
    "qd/algorithms/options.py": {
        "options: {error}": "repeats an error in this grammar",
        "{name}: a setting of type": "about a class in this package",
    },
    "qd/config.py": {
        "cannot read {path}": "the operating system's error",
        "{path} is not": "about a file, not a value",
        "{path} has format": "about a file, not a value",
        "{path}: {error}": "repeats an error in this grammar",
    },
    "qd/run/evolution.py": {
        "_other_start(config": "that function calls message",
        "str(error)": "repeats an error in this grammar",
    },
    "qd/scoring/task.py": {
        "env_options: {error}": "repeats an error in this grammar",
        "randomize: {error}": "repeats an error in this grammar",
    },
    "qd/emitters/arborescence.py": {
        "extra_scores['gradients'] or the scores": "about a result, not a value",
    },
    "wrappers/completed_eval.py": {"Incorrect type for state_metrics": "QDax's words"},
    "wrappers/evaluation.py": {"Incorrect type for state_metrics": "QDax's words"},
}


def functions(path: Path) -> Iterator[ast.Module | ast.FunctionDef]:
    """Every function of a file, and the file itself."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    yield tree
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            yield node


def built(node: ast.AST, names: set[str]) -> bool:
    """Whether a text is made by one of the builders, or is a name of such a text."""
    for part in ast.walk(node):
        if isinstance(part, ast.Name) and part.id in names | BUILDERS:
            return True
    return False


def texts(path: Path) -> Iterator[tuple[int, str]]:
    """Line and text of every error about arguments that no builder has made."""
    constants: set[str] = set()
    for function in functions(path):  # the file itself is the first one
        module = isinstance(function, ast.Module)
        names = constants | {
            target.id
            for node in (function.body if module else ast.walk(function))
            if isinstance(node, ast.Assign) and built(node.value, set())
            for target in node.targets
            if isinstance(target, ast.Name)
        }
        if module:
            constants = names
        for node in own_raises(function):
            call = node.exc
            if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name):
                continue
            if call.func.id in ARGUMENTS and not built(
                ast.Tuple(call.args, ast.Load()), names
            ):
                yield node.lineno, ast.unparse(call.args[0]) if call.args else ""


def own_raises(function: ast.AST) -> Iterator[ast.Raise]:
    """Raises of a function, without those of functions inside it."""
    for node in ast.iter_child_nodes(function):
        if isinstance(node, ast.Raise):
            yield node
        elif not isinstance(node, ast.FunctionDef):
            yield from own_raises(node)


FILES = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("name", FILES)
def test_errors_about_arguments_have_one_grammar(name: str) -> None:
    """``checks.message`` makes them; the few others have a reason."""
    if name == "checks.py":
        return
    excused = EXCEPTIONS.get(name, {})
    found = {line: re.sub("^f?['\"]", "", text) for line, text in texts(PACKAGE / name)}
    wrong = {
        line: text
        for line, text in found.items()
        if not any(text.startswith(beginning) for beginning in excused)
    }
    assert not wrong, f"{name}: {wrong}"
    unused = [b for b in excused if not any(t.startswith(b) for t in found.values())]
    assert not unused, "an exception that nothing needs"


OLD = (": allowed:", " given; allowed", "; expected ", " must be ", "got {")


@pytest.mark.parametrize("name", FILES)
def test_no_other_grammar(name: str) -> None:
    """No text of an error is written in one of the older grammars."""
    tree = ast.parse((PACKAGE / name).read_text(encoding="utf-8"))
    raised = itertools.chain.from_iterable(
        ast.walk(node) for node in ast.walk(tree) if isinstance(node, ast.Raise)
    )
    parts = [str(n.value) for n in raised if isinstance(n, ast.Constant)]
    old = [text for text in parts if any(mark in text for mark in OLD)]
    assert not old
