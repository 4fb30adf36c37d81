"""The algebra of packs: every adjoint against differences, worlds independent."""

from __future__ import annotations

import functools
import importlib
import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp
from unoptimized import leave_unoptimized

from newton_qd.physics.precision import Variant, build_kernels

WIDTH = 4
STEP = 1e-6


@functools.cache
def functions() -> dict[str, Any]:
    """Every overload that has an adjoint, by its name and argument types."""
    package = build_kernels(Variant("float64", WIDTH)).package.__name__
    found = {}
    for part in ("operators", "algebra", "numbers", "smooth"):
        module = importlib.import_module(f"{package}.cpp.{part}")
        for name, value in vars(module).items():
            for signature, overload in getattr(value, "user_overloads", {}).items():
                if overload.adj_native_snippet:
                    found[f"{name}_{signature}"] = overload
    return found


def is_pack(kind: Any) -> bool:
    """Whether a type holds one value for each world."""
    return getattr(kind, "_shape_", (0,))[-1] == WIDTH


def is_square(function: Any) -> bool:
    """Whether a function takes two packs of the same type."""
    kinds = list(function.input_types.values())
    return len(kinds) == 2 and kinds[0] is kinds[1] and is_pack(kinds[0])


@pytest.fixture(scope="module")
def applied(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Kernels that apply each function to the first elements of arrays."""
    lines = ["import warp as wp"]
    for n, function in enumerate(functions().values()):
        names = list(function.input_types)
        arguments = "".join(f"{name}: wp.array(dtype=T{n}{name}), " for name in names)
        lines += [
            f"F{n} = SHARED[{n}][0]",
            *(f"T{n}{name} = SHARED[{n}][1][{name!r}]" for name in names),
            "@wp.kernel",
            f"def apply_{n}({arguments}y: wp.array(dtype=SHARED[{n}][2])):",
            f"    y[0] = F{n}({', '.join(f'{name}[0]' for name in names)})",
        ]
        if is_square(function):
            lines += [
                "@wp.kernel",
                f"def twice_{n}(a: wp.array(dtype=T{n}{names[0]}), "
                f"y: wp.array(dtype=SHARED[{n}][2])):",
                "    x = a[0]",
                f"    y[0] = F{n}(x, x)",
            ]
    path = Path(tmp_path_factory.mktemp("algebra")) / "applied.py"
    path.write_text("\n".join(lines) + "\n")
    spec = importlib.util.spec_from_file_location("applied", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    module.SHARED = [  # type: ignore[attr-defined]
        (function, function.input_types, function.func.__annotations__["return"])
        for function in functions().values()
    ]
    spec.loader.exec_module(module)
    leave_unoptimized(module)
    made = {}
    for n, (name, function) in enumerate(functions().items()):
        made[name] = getattr(module, f"apply_{n}")
        if is_square(function):
            made[f"{name}_twice"] = getattr(module, f"twice_{n}")
    return made


def arrays(function: Any, values: dict[str, np.ndarray]) -> list[Any]:
    """Arguments as Warp arrays of one element, and the result."""
    kinds = [
        *function.input_types.items(),
        ("", function.func.__annotations__["return"]),
    ]
    return [
        wp.array(values[name][None], dtype=kind, device="cpu", requires_grad=True)
        if name
        else wp.zeros(1, dtype=kind, device="cpu", requires_grad=True)
        for name, kind in kinds
    ]


def evaluate(kernel: Any, function: Any, values: dict[str, np.ndarray]) -> np.ndarray:
    """Result of a function."""
    held = arrays(function, values)
    wp.launch(kernel, dim=1, inputs=held, device="cpu")
    return held[-1].numpy()[0]


def random_values(function: Any, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Arguments: positive numbers, so that roots and widths are meant; an index 1."""
    values = {}
    for name, kind in function.input_types.items():
        shape = getattr(kind, "_shape_", ())
        if kind is int:
            values[name] = np.array(1, np.int32)
        else:
            values[name] = rng.uniform(0.3, 1.7, shape)
    if "gap" in values:
        # beyond the zone on either side, and twice inside
        values["gap"] = values["width"] * np.array([-1.5, -0.4, 0.6, 1.5])
    return values


@pytest.mark.parametrize("name", functions())
def test_adjoint(applied: dict[str, Any], name: str) -> None:
    function, kernel = functions()[name], applied[name]
    rng = np.random.default_rng(0)
    values = random_values(function, rng)
    held = arrays(function, values)
    weight = rng.normal(size=held[-1].numpy().shape)
    held[-1].grad.assign(weight)
    wp.launch(
        kernel,
        dim=1,
        inputs=held,
        adj_inputs=[None for _ in held],
        adjoint=True,
        device="cpu",
    )
    for (argument, kind), array in zip(
        function.input_types.items(), held, strict=False
    ):
        if not is_pack(kind):
            continue
        found = array.grad.numpy()[0]
        for index in np.ndindex(values[argument].shape):
            slopes = 0.0
            for sign in (1.0, -1.0):
                moved = values[argument].copy()
                moved[index] += sign * STEP
                y = evaluate(kernel, function, values | {argument: moved})
                slopes = slopes + sign * y / (2.0 * STEP)
            expected = np.sum(slopes * weight[0])
            assert found[index] == pytest.approx(expected, rel=1e-6, abs=1e-8), index
            # nothing reaches another world
            others = np.delete(slopes, index[-1], axis=-1)
            assert not others.any()


@pytest.mark.parametrize("name", [n for n, f in functions().items() if is_square(f)])
def test_one_variable_twice(applied: dict[str, Any], name: str) -> None:
    function = functions()[name]
    first, second = function.input_types
    values = random_values(function, np.random.default_rng(1))
    values[second] = values[first]
    apart = arrays(function, values)
    shared = [arrays(function, values)[0], arrays(function, values)[-1]]
    for kernel, held in ((name, apart), (f"{name}_twice", shared)):
        held[-1].grad.fill_(1.0)
        unused = [None for _ in held]
        wp.launch(
            applied[kernel], 1, held, adj_inputs=unused, adjoint=True, device="cpu"
        )
    expected = apart[0].grad.numpy() + apart[1].grad.numpy()
    np.testing.assert_allclose(shared[0].grad.numpy(), expected, rtol=1e-12)


@pytest.mark.parametrize("width", [1e-110, 5e-324, 0.0])
def test_penetration_keeps_its_digits(applied: dict[str, Any], width: float) -> None:
    """At the edge of a contact's zone the width of its clipping underflows."""
    name = next(name for name in functions() if name.startswith("penetration"))
    function, ratio = functions()[name], np.array([-1.5, -0.4, 0.6, 1.5])
    wide = evaluate(applied[name], function, {"gap": ratio, "width": np.ones(4)})
    values = {"gap": width * ratio, "width": np.full(4, width)}
    held = arrays(function, values)
    held[-1].grad.fill_(1.0)
    unused = [None for _ in held]
    wp.launch(applied[name], 1, held, adj_inputs=unused, adjoint=True, device="cpu")
    assert all(np.isfinite(array.grad.numpy()).all() for array in held)
    found = evaluate(applied[name], function, values)
    np.testing.assert_allclose(found, width * wide, rtol=1e-14, atol=1e-323)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 1.999, 2.001, 9.0])
def test_exponential_map(applied: dict[str, Any], angle: float) -> None:
    name = next(name for name in functions() if name.startswith("turn_by"))
    axis = np.array([0.48, -0.6, 0.64])
    turn = np.tile((angle * axis)[:, None], WIDTH)
    got = evaluate(applied[name], functions()[name], {"a": turn})
    half = angle / 2.0
    expected = np.append(np.sin(half) * axis, np.cos(half))
    np.testing.assert_allclose(got, np.tile(expected[:, None], WIDTH), atol=2e-15)
