"""Checks of the options of environments, by their type annotations."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.envs.shown import OPTIONS

Constructor = TypeVar("Constructor", bound=Callable[..., None])


def checked_options(init: Constructor) -> Constructor:
    """Decorates a constructor: checks its options by their type annotations.

    A ``float`` must be a finite number, and not below 0 if it scales noise. A
    ``tuple[float, float]`` must be a range, the lowest value first. A ``bool`` must be
    ``True`` or ``False``. With ``| None``, each may be ``None``, too. The constructor
    checks other parameters itself.

    Args:
        init: An ``__init__`` whose options are keyword-only.

    Raises:
        TypeError: It decorates a class.
    """
    if inspect.isclass(init):
        allowed = "an __init__; write the decorator above it, inside of the class"
        raise TypeError(message("init", init, allowed))
    parameters = inspect.signature(init).parameters
    kinds = {name: _kind(each.annotation) for name, each in parameters.items()}

    @functools.wraps(init)
    def checked(self: Any, *args: Any, **options: Any) -> None:
        for name, value in options.items():
            kind, optional = kinds.get(name, ("", False))
            if kind in _CHECKS and not (optional and value is None):
                _CHECKS[kind](name, value)
        vars(self).setdefault(OPTIONS, options)  # of the class itself, for its text
        init(self, *args, **options)

    return checked  # pyright: ignore[reportReturnType]


def _kind(annotation: object) -> tuple[str, bool]:
    """Returns the text of a type without ``None``, and whether ``None`` is allowed.

    An annotation is text in a module with ``from __future__ import annotations``, and
    otherwise a type.
    """
    written = isinstance(annotation, str)
    text = annotation if written else inspect.formatannotation(annotation)
    text = text.replace(" ", "").removeprefix("typing.")
    if text.startswith("Optional["):
        text = f"{text.removeprefix('Optional[').removesuffix(']')}|None"
    kinds = text.split("|")
    return "|".join(kind for kind in kinds if kind != "None"), "None" in kinds


def _number(name: str, value: object) -> None:
    checks.number(name, value, least=0 if "noise_scale" in name else None)


_CHECKS: dict[str, Callable[[str, Any], None]] = {
    "float": _number,
    "tuple[float,float]": checks.interval,
    "bool": checks.flag,
}
