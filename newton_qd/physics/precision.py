"""The kernels in each precision."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import warp as wp

_TEMPLATE = Path(__file__).parent / "kernels"
SCALARS = {"float32": wp.float32, "float64": wp.float64}


@functools.cache
def kernels(dtype: str) -> SimpleNamespace:
    """Load the kernel package for one scalar type.

    Args:
        dtype: ``"float32"`` or ``"float64"``.

    Returns:
        The modules of :mod:`newton_qd.physics.kernels` as attributes, loaded under a
        package name of their own so that Warp compiles each precision separately.
    """
    name = f"newton_qd.physics.kernels_{dtype}"
    spec = importlib.util.spec_from_file_location(
        name, _TEMPLATE / "__init__.py", submodule_search_locations=[str(_TEMPLATE)]
    )
    assert spec is not None and spec.loader is not None
    package = importlib.util.module_from_spec(spec)
    package.real = SCALARS[dtype]  # type: ignore[attr-defined]
    sys.modules[name] = package
    spec.loader.exec_module(package)
    modules = ("structs", "world", "forward", "backward", "inspect")
    loaded = {
        module: importlib.import_module(f"{name}.{module}")
        for module in modules
        if (_TEMPLATE / f"{module}.py").exists()
    }
    return SimpleNamespace(package=package, **loaded)


def quiet() -> None:
    """Keep Warp's notices off the terminal, for programs with output of their own."""
    wp.config.log_level = wp.LOG_WARNING
