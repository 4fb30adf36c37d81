"""Old place of the defaults that depend on the environment."""

from __future__ import annotations

import warnings
from typing import Any

# Algorithms with defaults for environments when this module had the table.
_THEN = ("me-gradient", "omg-mega", "cma-mega", "cma-maega")


def __getattr__(name: str) -> Any:
    """Collects the defaults of all algorithms.

    Raises:
        AttributeError: The module never had the name.
    """
    if name != "TUNED":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from newton_qd.qd.algorithms import ALGORITHMS

    warnings.warn(
        f"{__name__}.TUNED is now tuned of each of newton_qd.qd.algorithms.ALGORITHMS",
        DeprecationWarning,
        stacklevel=2,
    )
    found: dict[str, dict[str, Any]] = {}
    for spec in ALGORITHMS:
        if spec.name not in _THEN:
            continue
        for env_name, defaults in spec.tuned.items():
            found[env_name] = {**found.get(env_name, {}), **defaults}
    return found
