"""Names of a package that are loaded when they are first used."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any


def loaded_name(package: dict[str, Any], name: str, homes: Mapping[str, str]) -> Any:
    """Returns a name of a package and keeps it there, for its ``__getattr__``.

    Args:
        package: ``globals()`` of the package.
        name: The name.
        homes: Module of every name; ``".module"`` is one inside the package.

    Raises:
        AttributeError: The package has no such name.
    """
    own = package["__name__"]
    if name not in homes:
        raise AttributeError(f"module {own!r} has no attribute {name!r}")
    package[name] = getattr(importlib.import_module(homes[name], own), name)
    return package[name]
