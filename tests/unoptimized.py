"""Kernels that only tests have, and that they run for a moment.

Warp's compiler takes half as long without optimization. The kernels of the package are
optimized in tests, as for users.
"""

from __future__ import annotations

from types import ModuleType

import warp as wp


def leave_unoptimized(module: ModuleType) -> None:
    """Compiles the kernels of a module fast from now on."""
    wp.set_module_options({"optimization_level": 0}, module)
