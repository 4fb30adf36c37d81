"""Old names of a module: they still work, with a warning that tells the new name."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Mapping


def moved_name(module: str, name: str, moved: Mapping[str, str]) -> object:
    """Returns the object with an old name, for the ``__getattr__`` of a module.

    Args:
        module: ``__name__`` of the module that had the name.
        name: The old name.
        moved: New dotted name, module first, of every old name.

    Returns:
        The object, after a ``DeprecationWarning`` that tells the new name.

    Raises:
        AttributeError: The module never had the name.
    """
    if name not in moved:
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    home, _, new = moved[name].rpartition(".")
    # frame 1 is this function, frame 2 is __getattr__, frame 3 is the caller
    warnings.warn(
        f"{module}.{name} is now {moved[name]}", DeprecationWarning, stacklevel=3
    )
    return getattr(importlib.import_module(home), new)
