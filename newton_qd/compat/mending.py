"""Mends modules of others when they are imported. Their files do not change."""

from __future__ import annotations

import functools
from collections.abc import Callable
from importlib.abc import Loader
from importlib.machinery import ModuleSpec
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from newton_qd.envs.env import Env


def mend_plotting(module: ModuleType) -> None:
    """Lets QDax's plots run with new releases.

    NumPy 2 has lost ``ndarray.ptp``, which Voronoi plots need. Matplotlib 3.9 has lost
    ``cm.get_cmap``, which plots of Pareto fronts need.
    """
    if not hasattr(module.cm, "get_cmap"):
        get_cmap = module.plt.get_cmap
        names = SimpleNamespace(**vars(module.cm), get_cmap=get_cmap)
        module.cm = names  # type: ignore[attr-defined]
    original = module.get_voronoi_finite_polygons_2d

    @functools.wraps(original)
    def polygons(centroids: np.ndarray, radius: float | None = None) -> Any:
        return original(centroids, np.ptp(centroids) if radius is None else radius)

    if not hasattr(original, "__wrapped__"):
        module.get_voronoi_finite_polygons_2d = polygons  # type: ignore[attr-defined]


def mend_envs(module: ModuleType) -> None:
    """Makes this library's environments instances of brax v1's ``Env``."""
    register = getattr(module.Env, "register", None)
    if register is not None:
        register(Env)


MENDED: dict[str, Callable[[ModuleType], None]] = {
    "qdax.utils.plotting": mend_plotting,
    "brax.v1.envs": mend_envs,
}
"""Modules that are not replaced, and what mends them."""


class MendingLoader(Loader):
    """Loads a module as its own loader does, then mends it."""

    def __init__(self, spec: ModuleSpec) -> None:
        """Stores the loader of a module.

        Args:
            spec: Spec of the module, whose loader exists.
        """
        assert spec.loader is not None
        self._own = spec.loader

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        """Returns the empty module, as its own loader makes it."""
        return self._own.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        """Fills the module, and mends it."""
        self._own.exec_module(module)
        MENDED[module.__name__](module)
