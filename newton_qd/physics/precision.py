"""The kernels in each precision and width."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import warp as wp

_TEMPLATE = Path(__file__).parent / "kernels"
_VECTOR_BYTES = 32
# Warp's default for CPUs. For CUDA it has 3, which compiles twice as long for kernels
# that are 3 % faster (docs/verification.md).
_OPTIMIZATION = 2
SCALARS = {"float32": wp.float32, "float64": wp.float64}


def kernels(
    dtype: str, width: int, *, parametric: bool = False, boxes: bool = False
) -> SimpleNamespace:
    """Load the kernel package for one scalar type and one width.

    Args:
        dtype: ``"float32"`` or ``"float64"``.
        width: Worlds of a pack, see :mod:`newton_qd.physics.kernels`.
        parametric: Whether every world brings physical parameters of its own.
        boxes: Whether obstacles may be boxes.

    Returns:
        The modules of :mod:`newton_qd.physics.kernels` as attributes, loaded under a
        package name of their own so that Warp compiles each variant separately.
    """
    return _load(dtype, width, parametric, boxes)


@functools.cache
def _load(dtype: str, width: int, parametric: bool, boxes: bool) -> SimpleNamespace:
    own = "_parametric" * parametric + "_boxes" * boxes
    name = f"newton_qd.physics.kernels_{dtype}_{width}{own}"
    spec = importlib.util.spec_from_file_location(
        name, _TEMPLATE / "__init__.py", submodule_search_locations=[str(_TEMPLATE)]
    )
    assert spec is not None and spec.loader is not None
    package = importlib.util.module_from_spec(spec)
    package.scalar = SCALARS[dtype]  # type: ignore[attr-defined]
    package.width = width  # type: ignore[attr-defined]
    package.parametric = parametric  # type: ignore[attr-defined]
    package.boxes = boxes  # type: ignore[attr-defined]
    sys.modules[name] = package
    spec.loader.exec_module(package)
    modules = ("structs", "world", "forward", "backward", "inspect", "gaps", "episodes")
    loaded = {
        module: importlib.import_module(f"{name}.{module}")
        for module in modules
        if (_TEMPLATE / f"{module}.py").exists()
    }
    level = wp.config.optimization_level
    level = _OPTIMIZATION if level is None else level
    for module in loaded.values():
        wp.set_module_options({"optimization_level": level}, module)
    return SimpleNamespace(package=package, **loaded)


def pack_width(dtype: str, device: Any) -> int:
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
