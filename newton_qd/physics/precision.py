"""The variants of the kernels, and how each is built.

The kernel package is a template: :func:`build_kernels` runs its files once for each
:class:`Variant`, as a package of its own name. A file of the template asks
:func:`variant_of` which variant it is a part of. docs/physics.md says why the files are
run again, and not wrapped in functions.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import warp as wp

_TEMPLATE = Path(__file__).parent / "kernels"
_TEMPLATE_PACKAGE = "newton_qd.physics.kernels"
_VECTOR_BYTES = 32
# Warp's default for CPUs. For CUDA it has 3, which compiles twice as long for kernels
# that are 3 % faster (docs/verification.md).
_OPTIMIZATION = 2
SCALARS = {"float32": wp.float32, "float64": wp.float64}


@dataclasses.dataclass(frozen=True)
class Variant:
    """What a copy of the kernels is compiled for, and what is left out of it.

    Attributes:
        dtype: ``"float32"`` or ``"float64"``.
        width: Worlds of a pack, see :mod:`newton_qd.physics.kernels`.
        parametric: Whether every world brings physical parameters of its own.
        boxes: Whether obstacles may be boxes.
    """

    dtype: str
    width: int
    parametric: bool = False
    boxes: bool = False

    @property
    def scalar(self) -> type:
        """Warp's type of a number."""
        return SCALARS[self.dtype]

    @property
    def package(self) -> str:
        """Name of the variant's package, and of its modules for Warp's cache."""
        own = "_parametric" * self.parametric + "_boxes" * self.boxes
        return f"{_TEMPLATE_PACKAGE}_{self.dtype}_{self.width}{own}"


@dataclasses.dataclass(frozen=True)
class Kernels:
    """The modules of one variant that others launch or read.

    Attributes:
        package: Types of a number and of vectors.
        structs: The structs that kernels take.
        world: What moves inputs and outputs.
        forward: ``step_forward``.
        backward: ``step_backward``.
        inspect: Kinematics and dynamics.
        gaps: ``contact_gaps``.
        episodes: Descriptors of episodes.
    """

    package: ModuleType
    structs: ModuleType
    world: ModuleType
    forward: ModuleType
    backward: ModuleType
    inspect: ModuleType
    gaps: ModuleType
    episodes: ModuleType


# The template under its own name is a variant too: of one world, with boxes. Tools
# import it so, and `conventions`, which does not depend on the variant.
_VARIANTS = {_TEMPLATE_PACKAGE: Variant("float32", 1, boxes=True)}


def variant_of(package: str) -> Variant:
    """Returns the variant that a package of kernels is built for.

    Args:
        package: Its ``__name__``.

    Raises:
        KeyError: :func:`build_kernels` did not build it.
    """
    return _VARIANTS[package]


@functools.cache
def build_kernels(variant: Variant) -> Kernels:
    """Runs the kernel package for a variant; once, and compiles nothing.

    Args:
        variant: Precision, width, and what is left out.

    Returns:
        The modules of the variant. Their names begin with ``variant.package``, so that
        Warp compiles and caches each variant by itself.
    """
    _VARIANTS[variant.package] = variant
    package = _run_template(variant.package)
    names = [field.name for field in dataclasses.fields(Kernels)[1:]]
    modules = {
        name: importlib.import_module(f"{variant.package}.{name}") for name in names
    }
    level = wp.config.optimization_level
    level = _OPTIMIZATION if level is None else level
    for module in modules.values():
        wp.set_module_options({"optimization_level": level}, module)
    return Kernels(package, **modules)


def _run_template(name: str) -> ModuleType:
    """Imports the template as a package called ``name``."""
    spec = importlib.util.spec_from_file_location(
        name, _TEMPLATE / "__init__.py", submodule_search_locations=[str(_TEMPLATE)]
    )
    assert spec is not None and spec.loader is not None
    package = importlib.util.module_from_spec(spec)
    sys.modules[name] = package
    try:
        spec.loader.exec_module(package)
    except BaseException:
        del sys.modules[name]
        raise
    return package


def pack_width(dtype: str, device: wp.Device) -> int:
    """Worlds that one thread of a device computes side by side.

    Args:
        dtype: ``"float32"`` or ``"float64"``.
        device: Warp device.

    Returns:
        1 on a GPU; on a CPU what fills a vector register of 256 bits.
    """
    if not device.is_cpu:
        return 1
    return _VECTOR_BYTES // (4 if dtype == "float32" else 8)


def quiet() -> None:
    """Keep Warp's notices off the terminal, for programs with output of their own."""
    wp.config.log_level = wp.LOG_WARNING
