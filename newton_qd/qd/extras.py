"""The optional dependencies of this package."""

from __future__ import annotations

import importlib.util

from newton_qd.errors import MissingExtra


def require_extra(package: str, extra: str) -> None:
    """Checks that an optional dependency is installed.

    Args:
        package: Name of the module to import.
        extra: Extra of ``newton_qd`` that installs it.

    Raises:
        MissingExtra: It is not installed.
    """
    if importlib.util.find_spec(package) is None:
        raise MissingExtra(package, extra)
