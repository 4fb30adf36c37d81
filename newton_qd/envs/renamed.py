"""Methods of a subclass that are written as for older code: names and arguments."""

from __future__ import annotations

import contextlib
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
_SYNONYMS = {
    "behavior_descriptor_length": "descriptor_length",
    "behavior_descriptor_limits": "descriptor_limits",
}
"""Names of QDax up to 0.4, and those of later releases."""


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


def share_synonyms(kind: type) -> None:
    """Gives a class both names of a property of which it overrides one.

    Without this, the other name would still be the property of a base class.

    Args:
        kind: A class that has just been made.
    """
    for pair in _SYNONYMS.items():
        # the nearest class with one of them decides; it may be a mixin
        nearest = next((vars(c) for c in kind.__mro__ if vars(c).keys() & pair), {})
        for name, synonym in (pair, pair[::-1]):
            if name in nearest and synonym not in nearest:
                setattr(kind, synonym, nearest[name])


def accept_params(kind: type) -> None:
    """Lets a class have ``step(self, state, action)``, as environments of QDax have it.

    Wrappers pass ``params`` as a third argument.

    Args:
        kind: A class that has just been made.
    """
    step = inspect.getattr_static(kind, "step", None)
    # what is inherited is ready; what is no method of an instance stays as it is
    if getattr(step, "accepts_params", False) or not hasattr(step, "__get__"):
        return
    if not callable(step) or isinstance(step, staticmethod | classmethod):
        return
    signature = inspect.signature(step)
    with contextlib.suppress(TypeError):
        signature.bind(None, None, None, None)
        return  # it takes a third argument
    named = "params" in signature.parameters

    @functools.wraps(step)
    def step_without_params(self: Any, *given: Any, **options: Any) -> Any:
        if len(given) == 3 and "params" not in options:
            *given, options["params"] = given  # type: ignore[assignment]
        if not named and options.pop("params", None) is not None:
            allowed, why = "None", f"and step of {kind.__name__} does not take them"
            raise TypeError(message("params", Fact("parameters"), allowed, why=why))
        return step(self, *given, **options)

    step_without_params.accepts_params = True  # type: ignore[attr-defined]
    kind.step = step_without_params  # type: ignore[attr-defined]
