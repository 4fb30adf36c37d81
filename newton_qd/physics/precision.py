"""The variants of the kernels, and the function that builds them.

The kernel package is a template. :func:`build_kernels` runs its files once for each
:class:`Variant`, as a package with another name. A file of the template calls
:func:`variant_of` to find its variant. docs/physics.md explains why the files are run
again instead of being wrapped in functions.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import importlib.util
import sys
import threading
from pathlib import Path
from types import ModuleType

import warp as wp

_TEMPLATE = Path(__file__).parent / "kernels"
_TEMPLATE_PACKAGE = "newton_qd.physics.kernels"
_VECTOR_BYTES = 32
# Warp's default for CPUs. Its default for CUDA is 3. Level 3 doubles the compile time
# and makes the kernels 3 % faster (docs/verification.md).
_OPTIMIZATION = 2
# Modules in a folder of the package.
_FILES = {"memory": "cpp.memory"}
# Modules that variants with and without boxes and pairs share. Warp compiles their
# kernels once.
SHARED = ("answers", "bodies", "bodies_backward", "box", "coordinates", "cpp")
SHARED += ("dynamics", "inertia", "integration", "joints", "kinematics", "parameters")
SHARED += ("readings", "rows", "structs", "world")
SCALARS = {"float32": wp.float32, "float64": wp.float64}


@dataclasses.dataclass(frozen=True)
class Variant:
    """Precision, width and optional features of one copy of the kernels.

    Attributes:
        dtype: ``"float32"`` or ``"float64"``.
        width: Number of worlds in a pack, see :mod:`newton_qd.physics.kernels`.
        parametric: Whether each world has its own physical parameters.
        boxes: Whether obstacles may be boxes.
        pairs: Whether bodies of the robot may touch each other.
    """

    dtype: str
    width: int
    parametric: bool = False
    boxes: bool = False
    pairs: bool = False

    @property
    def scalar(self) -> type:
        """Warp's scalar type."""
        return SCALARS[self.dtype]

    @property
    def package(self) -> str:
        """Name of the variant's package. Warp's cache uses it as a prefix too."""
        own = "_parametric" * self.parametric + "_boxes" * self.boxes
        own += "_pairs" * self.pairs
        return f"{_TEMPLATE_PACKAGE}_{self.dtype}_{self.width}{own}"


@dataclasses.dataclass(frozen=True)
class Kernels:
    """The modules of one variant that other packages use.

    Attributes:
        package: The scalar and vector types.
        structs: The structs that kernels take as arguments.
        memory: What the arrays and tables of these structs are.
        world: Functions that read inputs and write outputs.
        forward: Kernel ``step_forward``.
        backward: Kernel ``step_backward``.
        bodies: Kernel ``bodies_forward``.
        bodies_backward: Kernel ``bodies_backward``.
        dynamics: Kernel ``dynamics_forward``.
        gaps: Kernel ``contact_gaps``.
        impulses: Kernel ``contact_impulses``.
        episodes: Kernels for descriptors of episodes.
    """

    package: ModuleType
    structs: ModuleType
    memory: ModuleType
    world: ModuleType
    forward: ModuleType
    backward: ModuleType
    bodies: ModuleType
    bodies_backward: ModuleType
    dynamics: ModuleType
    gaps: ModuleType
    impulses: ModuleType
    episodes: ModuleType


# The template under its own name is a variant too, with one world in a pack and with
# boxes. Tools import it under this name. So do users of `conventions`, which does not
# depend on the variant.
_VARIANTS = {_TEMPLATE_PACKAGE: Variant("float32", 1, boxes=True, pairs=True)}


def variant_of(package: str) -> Variant:
    """Returns the variant of a kernel package.

    Args:
        package: The package's ``__name__``.

    Raises:
        KeyError: :func:`build_kernels` did not build the package.
    """
    return _VARIANTS[package]


BUILDING = threading.RLock()
"""Held while kernels are built or compiled: several threads may make environments."""


def build_kernels(variant: Variant) -> Kernels:
    """Runs the kernel package for a variant. It does not compile anything.

    The result is cached: each variant is built once.

    Args:
        variant: Precision, width and optional features.

    Returns:
        The modules of the variant. Their names begin with ``variant.package``, so that
        Warp compiles and caches each variant separately. What does not depend on boxes
        and pairs comes from the variant without them.
    """
    with BUILDING:
        return _built(variant)


@functools.cache
def _built(variant: Variant) -> Kernels:
    _VARIANTS[variant.package] = variant
    package = _run_template(variant.package)
    plain = dataclasses.replace(variant, boxes=False, pairs=False)
    if plain != variant:
        _share(build_kernels(plain).package.__name__, variant.package)
    names = [field.name for field in dataclasses.fields(Kernels)[1:]]
    modules = {
        name: importlib.import_module(f"{variant.package}.{_FILES.get(name, name)}")
        for name in names
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


def _share(owner: str, package: str) -> None:
    """Lets a package import the shared modules of another one as its own."""
    for name in list(sys.modules):
        own = name.removeprefix(f"{owner}.")
        if own != name and own.split(".")[0] in SHARED:
            sys.modules[f"{package}.{own}"] = sys.modules[name]


def pack_width(dtype: str, device: wp.Device) -> int:
    """Returns the number of worlds in a pack, which one thread computes side by side.

    Args:
        dtype: ``"float32"`` or ``"float64"``.
        device: Warp device.

    Returns:
        1 on a GPU. On a CPU the number of scalars in a vector register of 256 bits.
    """
    if not device.is_cpu:
        return 1
    return _VECTOR_BYTES // (4 if dtype == "float32" else 8)
