"""What newton_qd uses of Warp's inside: found where it moved to, or one clear error."""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterator
from types import ModuleType, SimpleNamespace

import pytest
import warp as wp

from newton_qd.physics import warp_internals
from newton_qd.physics.warp_internals import UnsupportedWarpError

PLACES = (
    "warp._src.jax.ffi",
    "warp._src.jax_experimental.ffi",
    "warp.jax_experimental.ffi",
)


class FfiCallable:
    """As Warp's."""

    def ffi_callback(self) -> None:
        """As Warp's."""


@pytest.fixture(autouse=True)
def _fresh() -> Iterator[None]:
    caches = (warp_internals.ffi_module, warp_internals._context)
    for cache in caches:
        cache.cache_clear()
    yield
    for cache in caches:
        cache.cache_clear()


def hide(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Make modules impossible to import."""
    for name in names:
        monkeypatch.setitem(sys.modules, name, None)


def fake(monkeypatch: pytest.MonkeyPatch, name: str, **contents: object) -> ModuleType:
    """Put a module in the place of another."""
    module = ModuleType(name)
    module.__dict__.update(contents)
    monkeypatch.setitem(sys.modules, name, module)
    return module


def test_this_warp_has_everything() -> None:
    assert warp_internals.ffi_callback().__name__ == "ffi_callback"
    assert not warp_internals.tape_is_recording()
    with wp.Tape():
        assert warp_internals.tape_is_recording()
    assert not warp_internals.tape_is_recording()


@pytest.mark.parametrize("place", PLACES)
def test_callable_is_found_where_it_was(
    place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    hide(monkeypatch, *PLACES)
    module = fake(monkeypatch, place, FfiCallable=FfiCallable)
    assert warp_internals.ffi_module() is module
    assert warp_internals.ffi_callback() is FfiCallable.ffi_callback


def test_newest_place_is_taken_first(monkeypatch: pytest.MonkeyPatch) -> None:
    modules = [
        fake(monkeypatch, place, FfiCallable=FfiCallable) for place in PLACES[:2]
    ]
    assert warp_internals.ffi_module() is modules[0]


def test_place_without_the_method_is_passed_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fake(monkeypatch, PLACES[0], FfiCallable=type("FfiCallable", (), {}))
    module = fake(monkeypatch, PLACES[1], FfiCallable=FfiCallable)
    assert warp_internals.ffi_module() is module


def test_error_names_the_warp_and_those_that_work(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    hide(monkeypatch, *PLACES)
    monkeypatch.setattr(wp, "__version__", "99.0.0")
    with pytest.raises(UnsupportedWarpError) as raised:
        warp_internals.ffi_callback()
    text = str(raised.value)
    assert text.startswith("warp-lang: got version 99.0.0")
    assert "FfiCallable.ffi_callback" in text
    assert all(place in text for place in PLACES)
    assert "; allowed: " in text
    assert warp_internals._versions() in text


def test_versions_are_those_of_the_requirement(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    required = ["newton>=1.8.0", "warp-lang>=1.19.0,<1.20", "ribs; extra == 'all'"]
    monkeypatch.setattr(warp_internals.metadata, "requires", lambda name: required)
    assert warp_internals._versions() == ">=1.19.0,<1.20"


def test_versions_where_the_package_is_not_installed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def requires(name: str) -> list[str]:
        raise warp_internals.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(warp_internals.metadata, "requires", requires)
    assert "pyproject.toml" in warp_internals._versions()


def test_error_inside_a_place_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def import_module(name: str) -> ModuleType:
        raise ModuleNotFoundError("No module named 'jaxlib'", name="jaxlib")

    monkeypatch.setattr(warp_internals.importlib, "import_module", import_module)
    with pytest.raises(ModuleNotFoundError, match="jaxlib"):
        warp_internals.ffi_module()


def test_context_is_found_where_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    hide(monkeypatch, "warp._src.context")
    fake(monkeypatch, "warp.context", runtime=SimpleNamespace(tape=object()))
    assert warp_internals.tape_is_recording()


def test_nothing_records_before_warp_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    fake(monkeypatch, "warp._src.context", runtime=None)
    assert not warp_internals.tape_is_recording()


def test_runtime_that_hides_its_tape(monkeypatch: pytest.MonkeyPatch) -> None:
    fake(monkeypatch, "warp._src.context", runtime=SimpleNamespace())
    with pytest.raises(UnsupportedWarpError, match=r"runtime\.tape"):
        warp_internals.tape_is_recording()


def test_type_of_a_field() -> None:
    @wp.struct
    class Held:
        directions: wp.array[wp.vec3]

    assert warp_internals.field_dtype(Held, "directions") is wp.vec3
    with pytest.raises(UnsupportedWarpError, match="vars"):
        warp_internals.field_dtype(SimpleNamespace(), "directions")


def test_functions_are_marked() -> None:
    function = SimpleNamespace(skip_replay=False)
    assert warp_internals.never_replay(function) is function
    assert function.skip_replay
    with pytest.raises(UnsupportedWarpError, match="skip_replay"):
        warp_internals.never_replay(functools.partial(print))
    plain = SimpleNamespace(adj=SimpleNamespace(skip_reverse_codegen=False))
    assert warp_internals.never_differentiate(plain) is plain
    assert plain.adj.skip_reverse_codegen
    with pytest.raises(UnsupportedWarpError, match="skip_reverse_codegen"):
        warp_internals.never_differentiate(functools.partial(print))
