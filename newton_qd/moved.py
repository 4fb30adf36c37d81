"""Old names of a module: they keep working and say the new one."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Mapping
from typing import Any


def moved_name(module: str, name: str, moved: Mapping[str, str]) -> Any:
    """Returns what an old name of a module stands for now, for its ``__getattr__``.

    Args:
        module: ``__name__`` of the module that had the name.
        name: Name that was asked for.
        moved: New dotted name, module first, of every old name.

    Returns:
        The object, after a ``DeprecationWarning`` that says its new name.

    Raises:
        AttributeError: The module never had the name.
    """
    if name not in moved:
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    home, _, new = moved[name].rpartition(".")
    # frame 1 is this function, frame 2 is __getattr__, frame 3 is who asked
    warnings.warn(
        f"{module}.{name} is now {moved[name]}", DeprecationWarning, stacklevel=3
    )
    return getattr(importlib.import_module(home), new)
