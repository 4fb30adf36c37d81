"""The parts of Warp that its documentation does not name, all in this one file.

Warp offers no public way to do what is done here, and moves these parts between its
versions. So each is looked for in every place that it had, newest first, and where it
is in none of them one error says which Warp was found and which versions work.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable
from importlib import metadata
from types import ModuleType
from typing import Any, TypeVar

import warp as wp

FunctionT = TypeVar("FunctionT")

# Module that calls Python from XLA: since Warp 1.14, since 1.10, and before.
_FFI = (
    "warp._src.jax.ffi",
    "warp._src.jax_experimental.ffi",
    "warp.jax_experimental.ffi",
)
# Module that holds the state of the process: since Warp 1.10, and before.
_CONTEXT = ("warp._src.context", "warp.context")


class UnsupportedWarpError(ImportError):
    """The installed Warp lacks an undocumented part that newton_qd needs."""


def _versions() -> str:
    """Versions of Warp that newton_qd asks for, as its metadata states them."""
    try:
        required = metadata.requires("newton_qd") or []
    except metadata.PackageNotFoundError:
        required = []
    found = [entry for entry in required if entry.startswith("warp-lang")]
    return found[0].removeprefix("warp-lang") if found else "as in pyproject.toml"


def _unsupported(part: str, places: tuple[str, ...]) -> UnsupportedWarpError:
    return UnsupportedWarpError(
        f"warp-lang: got version {wp.__version__}, which has no {part} in "
        f"{' or '.join(places)}; allowed: {_versions()}"
    )


def _module_with(part: str, places: tuple[str, ...]) -> ModuleType:
    """First of several modules that exists and has ``part``, such as ``"A.b"``."""
    for place in places:
        try:
            module = importlib.import_module(place)
        except ModuleNotFoundError as error:
            # an import that fails inside of a module that is there is another error
            if not f"{place}.".startswith(f"{error.name}."):
                raise
            continue
        if _has(module, part):
            return module
    raise _unsupported(part, places)


def _has(owner: Any, part: str) -> bool:
    for name in part.split("."):
        if not hasattr(owner, name):
            return False
        owner = getattr(owner, name)
    return True


@functools.cache
def ffi_module() -> ModuleType:
    """The module of Warp whose functions XLA calls.

    Raises:
        UnsupportedWarpError: This Warp has none that is known.
    """
    return _module_with("FfiCallable.ffi_callback", _FFI)


def ffi_callback() -> Callable[..., object]:
    """The method that XLA enters Python by, when it runs a ``wp.jax_callable``.

    Raises:
        UnsupportedWarpError: This Warp has none that is known.
    """
    return ffi_module().FfiCallable.ffi_callback


@functools.cache
def _context() -> ModuleType:
    return _module_with("runtime", _CONTEXT)


def tape_is_recording() -> bool:
    """Whether the program is inside of a ``wp.Tape``.

    Raises:
        UnsupportedWarpError: This Warp does not say so.
    """
    module = _context()
    if module.runtime is None:  # nothing has run yet
        return False
    if not _has(module, "runtime.tape"):
        raise _unsupported("runtime.tape", (module.__name__,))
    return module.runtime.tape is not None


def field_dtype(struct: Any, name: str) -> type:
    """Type of the elements of an array in a struct.

    Args:
        struct: Class that ``wp.struct`` made.
        name: Field; an array.

    Returns:
        The Warp type, as ``wp.vec3``.

    Raises:
        UnsupportedWarpError: Structs of this Warp do not say so.
    """
    if not _has(struct, "vars"):
        raise _unsupported("vars", (type(struct).__qualname__,))
    return struct.vars[name].type.dtype


def never_replay(function: FunctionT) -> FunctionT:
    """Keep the adjoint of a caller from calling a function again for its results.

    Args:
        function: What ``wp.func`` made; changed in place.

    Returns:
        ``function``.

    Raises:
        UnsupportedWarpError: Functions of this Warp cannot be marked so; unmarked they
            would be called twice, and the gradient would be wrong.
    """
    if not _has(function, "skip_replay"):
        raise _unsupported("skip_replay", (type(function).__qualname__,))
    marked: Any = function
    marked.skip_replay = True
    return function
