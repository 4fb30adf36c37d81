"""All uses of undocumented parts of Warp.

Warp has no public interface for what this file does, and its versions have these parts
in different modules. The functions search all known modules, newest first. If a part is
missing, one error names the installed Warp and the versions that work.
"""

from __future__ import annotations

import ctypes
import dataclasses
import functools
import importlib
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
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
# Module that calls the compiler.
_BUILD = ("warp._src.build", "warp.build")


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


def load_native(source: Path, target: Path) -> Callable[[str], int]:
    """Load a C++ file into this process. Warp's compiler compiles it first.

    Args:
        source: File without headers.
        target: Object file. It is written if it does not exist, and not needed later.

    Returns:
        Function that returns the address of an exported name.

    Raises:
        UnsupportedWarpError: The installed Warp cannot compile or load it.
    """
    wp.init()
    context = _context()
    for part in ("wp_load_obj", "wp_lookup"):
        if not _has(context, f"runtime.llvm.{part}"):
            raise _unsupported(f"runtime.llvm.{part}", (context.__name__,))
    if not target.exists():
        _module_with("build_cpu", _BUILD).build_cpu(str(target), str(source))
    native, name = context.runtime.llvm, f"newton_qd_{source.stem}".encode()
    if native.wp_load_obj(str(target).encode(), name, False) != 0:
        raise _unsupported("working wp_load_obj", (context.__name__,))
    return lambda symbol: native.wp_lookup(name, symbol.encode())


@dataclasses.dataclass(frozen=True, eq=False)
class CpuEntry:
    """A compiled kernel of a CPU and its arguments, as C functions take them.

    Attributes:
        function: Address of the kernel or of its adjoint.
        bounds: First argument: what the kernel is launched on.
        arguments: Second argument: a struct of the kernel's arguments.
        adjoint_arguments: Third argument of an adjoint.
        values: The kernel's arguments by name.
        launch: The launch. It keeps the code in memory.
    """

    function: int
    bounds: ctypes.Structure
    arguments: ctypes.Structure
    adjoint_arguments: ctypes.Structure | None
    values: dict[str, Any]
    launch: wp.Launch

    @property
    def offsets(self) -> dict[str, int]:
        """Place of each argument in ``arguments`` [bytes], in the kernel's order."""
        kind = type(self.arguments)
        return {name: getattr(kind, name).offset for name in self.values}


def cpu_entry(launch: wp.Launch, adjoint: bool) -> CpuEntry:
    """Returns a recorded launch on a CPU as a C function and its arguments.

    Args:
        launch: The launch.
        adjoint: Whether it runs the adjoint of its kernel.

    Raises:
        UnsupportedWarpError: Launches of the installed Warp do not expose them.
    """
    for part in ("hooks.forward", "params", "bounds", "kernel.adj.args"):
        if not _has(launch, part):
            raise _unsupported(part, (type(launch).__qualname__,))
    own: Any = launch
    names = [argument.label for argument in own.kernel.adj.args]
    given = own.params[1:]
    function = own.hooks.backward if adjoint else own.hooks.forward
    address = ctypes.cast(function, ctypes.c_void_p).value
    assert address is not None  # the launch has loaded the module
    return CpuEntry(
        address,
        own.bounds,
        _argument_struct(names, given[: len(names)]),
        _argument_struct(names, given[len(names) :]) if adjoint else None,
        dict(zip(names, given, strict=False)),
        launch,
    )


def _argument_struct(names: list[str], values: list[Any]) -> ctypes.Structure:
    fields = [(name, type(value)) for name, value in zip(names, values, strict=True)]
    struct = type("Arguments", (ctypes.Structure,), {"_fields_": fields})()
    for name, value in zip(names, values, strict=True):
        setattr(struct, name, value)
    return struct


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
