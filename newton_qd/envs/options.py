"""Checks of the options of environments, by their type annotations."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar

from newton_qd import checks
from newton_qd.envs.shown import OPTIONS

Constructor = TypeVar("Constructor", bound=Callable[..., None])


def checked_options(init: Constructor) -> Constructor:
    """Decorates a constructor: checks its options by their type annotations.

    A ``float`` must be a finite number, and not below 0 if it scales noise; a
    ``float | None`` may be ``None``, too. A
    ``tuple[float, float]`` must be a range, the lowest value first. A ``bool`` must be
    ``True`` or ``False``. The constructor checks other parameters itself.

    Args:
        init: An ``__init__`` whose options are keyword-only.
    """
    parameters = inspect.signature(init).parameters
    kinds = {name: _text(each.annotation) for name, each in parameters.items()}

    @functools.wraps(init)
    def checked(self: Any, *args: Any, **options: Any) -> None:
        for name, value in options.items():
            _CHECKS.get(kinds.get(name, ""), _anything)(name, value)
        vars(self).setdefault(OPTIONS, options)  # of the class itself, for its text
        init(self, *args, **options)

    return checked  # pyright: ignore[reportReturnType]


def _text(annotation: object) -> str:
    """Returns an annotation as it is written, also where Python has evaluated it."""
    if isinstance(annotation, str):
        return annotation
    return inspect.formatannotation(annotation)


def _anything(name: str, value: object) -> None:
    del name, value


def _number(name: str, value: object) -> None:
    checks.number(name, value, least=0 if "noise_scale" in name else None)


def _number_or_none(name: str, value: object) -> None:
    if value is not None:
        _number(name, value)


_CHECKS: dict[str, Callable[[str, Any], None]] = {
    "float": _number,
    "float | None": _number_or_none,
    "tuple[float, float]": checks.interval,
    "bool": checks.flag,
}
