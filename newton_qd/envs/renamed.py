"""Old names of the methods that a subclass of ``PhysicsEnv`` overrides."""

from __future__ import annotations

import warnings

_RENAMED = {
    "_observe": "observe",
    "_outcome": "outcome",
    "_control": "control",
    "_place": "reset_pose",
}


def keep_old_names(kind: type) -> None:
    """Makes methods of a class work that are overridden by their old names.

    Args:
        kind: A class that has just been made.
    """
    for old, new in _RENAMED.items():
        if old in vars(kind):
            warnings.warn(
                f"{kind.__name__}.{old} is now {new}",
                DeprecationWarning,
                stacklevel=4,
            )
            setattr(kind, new, vars(kind)[old])
        elif new in vars(kind):
            setattr(kind, old, vars(kind)[new])
