"""The optional dependencies of this package."""

from __future__ import annotations

import importlib.util

from newton_qd.errors import MissingExtra


def require_extra(package: str, extra: str) -> None:
    """Refuses to go on without an optional dependency.

    Args:
        package: Name under which it is imported.
        extra: Extra of ``newton_qd`` that installs it.

    Raises:
        MissingExtra: It is not installed.
    """
    if importlib.util.find_spec(package) is None:
        raise MissingExtra(package, extra)
