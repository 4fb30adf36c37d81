"""All uses of undocumented parts of Warp.

Warp has no public interface for what this file does, and its versions have these parts
in different modules. The functions search all known modules, newest first. If a part is
missing, one error names the installed Warp and the versions that work.
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
    """Returns the versions of Warp that the metadata of newton_qd requires."""
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
    """Returns the first module that exists and has ``part``, for example ``"A.b"``."""
    for place in places:
        try:
            module = importlib.import_module(place)
        except ModuleNotFoundError as error:
            # The module exists, but an import inside it failed: a different error.
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
    """Returns the module of Warp whose functions XLA calls.

    Raises:
        UnsupportedWarpError: The installed Warp has no such module.
    """
    return _module_with("FfiCallable.ffi_callback", _FFI)


def ffi_callback() -> Callable[..., object]:
    """Returns the method that XLA calls to run a ``wp.jax_callable``.

    Raises:
        UnsupportedWarpError: The installed Warp has no such method.
    """
    return ffi_module().FfiCallable.ffi_callback


@functools.cache
def _context() -> ModuleType:
    return _module_with("runtime", _CONTEXT)


def tape_is_recording() -> bool:
    """Returns whether a ``wp.Tape`` is recording.

    Raises:
        UnsupportedWarpError: The installed Warp does not expose its tape.
    """
    module = _context()
    if module.runtime is None:  # nothing has run yet
        return False
    if not _has(module, "runtime.tape"):
        raise _unsupported("runtime.tape", (module.__name__,))
    return module.runtime.tape is not None


def field_type(struct: Any, name: str) -> Any:
    """Returns the type of a field of a struct.

    Args:
        struct: Class from ``wp.struct``.
        name: Name of a field.

    Returns:
        The Warp type; of a struct in the struct, its class.

    Raises:
        UnsupportedWarpError: Structs of the installed Warp do not expose their types.
    """
    if not _has(struct, "vars"):
        raise _unsupported("vars", (type(struct).__qualname__,))
    return struct.vars[name].type


def field_dtype(struct: Any, name: str) -> type:
    """Returns the type of the elements of an array in a struct.

    Args:
        struct: Class from ``wp.struct``.
        name: Name of a field. The field is an array.

    Returns:
        The Warp type, for example ``wp.vec3``.

    Raises:
        UnsupportedWarpError: Structs of the installed Warp do not expose their types.
    """
    return field_type(struct, name).dtype


def never_replay(function: FunctionT) -> FunctionT:
    """Mark a function so that the adjoint of its caller does not call it a second time.

    Args:
        function: Function from ``wp.func``. It is changed in place.

    Returns:
        ``function``.

    Raises:
        UnsupportedWarpError: The installed Warp has no such mark. Without it the
            function would run twice, and the gradient would be wrong.
    """
    if not _has(function, "skip_replay"):
        raise _unsupported("skip_replay", (type(function).__qualname__,))
    marked: Any = function
    marked.skip_replay = True
    return function


def never_differentiate(function: FunctionT) -> FunctionT:
    """Mark a function so that no adjoint is generated for it.

    Args:
        function: Function from ``wp.func``. It is changed in place.

    Returns:
        ``function``.

    Raises:
        UnsupportedWarpError: The installed Warp has no such mark.
    """
    if not _has(function, "adj.skip_reverse_codegen"):
        raise _unsupported("adj.skip_reverse_codegen", (type(function).__qualname__,))
    marked: Any = function
    marked.adj.skip_reverse_codegen = True
    return function
