"""Methods of a subclass that are written as for older code: names and arguments."""

from __future__ import annotations

import functools
import inspect
import warnings
from typing import Any

from newton_qd.checks import Fact, message

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


def accept_params(kind: type) -> None:
    """Lets a class have ``step(self, state, action)``, as environments of QDax have it.

    Wrappers pass ``params`` as a third argument.

    Args:
        kind: A class that has just been made.
    """
    step = vars(kind).get("step")
    if not inspect.isfunction(step):
        return
    arguments = inspect.signature(step).parameters.values()
    several = any(x.kind is x.VAR_POSITIONAL for x in arguments)
    if several or len([x for x in arguments if x.kind is not x.KEYWORD_ONLY]) != 3:
        return

    @functools.wraps(step)
    def step_without_params(self: Any, state: Any, action: Any, params: Any = None):
        if params is not None:
            given = Fact("parameters")
            why = f"and step of {kind.__name__} has no argument for them"
            raise TypeError(message("params", given, "None", why=why))
        return step(self, state, action)

    kind.step = step_without_params  # type: ignore[attr-defined]
