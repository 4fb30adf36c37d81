"""Options of environments: what their constructors refuse, by the types they state."""

from __future__ import annotations

import functools
import inspect
import math
import numbers
from collections.abc import Callable
from typing import Any, TypeGuard, TypeVar

import numpy as np
from numpy.typing import DTypeLike

Constructor = TypeVar("Constructor", bound=Callable[..., None])


def checked_options(init: Constructor) -> Constructor:
    """Lets a constructor refuse values that its options do not allow.

    Options annotated ``float`` are finite numbers, not below 0 if they scale noise;
    ``tuple[float, float]`` are ranges, the lowest value before the highest; ``bool``
    are ``True`` or ``False``. Other parameters are left to the constructor.

    Args:
        init: An ``__init__`` whose options are keyword-only.
    """
    parameters = inspect.signature(init).parameters
    kinds = {name: str(parameter.annotation) for name, parameter in parameters.items()}

    @functools.wraps(init)
    def checked(self: Any, *args: Any, **options: Any) -> None:
        for name, value in options.items():
            _CHECKS.get(kinds.get(name, ""), _anything)(name, value)
        init(self, *args, **options)

    return checked  # pyright: ignore[reportReturnType]


def _anything(name: str, value: object) -> None:
    del name, value


def check_number(name: str, value: object) -> None:
    """Raises where a number is none, or scales noise and is below 0.

    Raises:
        TypeError: It is no number.
        ValueError: It is not finite, or below 0 and scales noise.
    """
    allowed = "finite numbers from 0" if "noise_scale" in name else "finite numbers"
    if not is_number(value):
        raise TypeError(f"{name}={value!r}: allowed: {allowed}")
    if not math.isfinite(value) or ("noise_scale" in name and value < 0):
        raise ValueError(f"{name}={value!r}: allowed: {allowed}")


def _range(name: str, value: object) -> None:
    allowed = "two numbers, lowest below highest"
    if not isinstance(value, (tuple, list, np.ndarray)) or len(value) != 2:
        raise TypeError(f"{name}={value!r}: allowed: {allowed}")
    if not all(is_number(end) for end in value):
        raise TypeError(f"{name}={value!r}: allowed: {allowed}")
    if not value[0] < value[1]:
        raise ValueError(f"{name}={value!r}: allowed: {allowed}")


def check_flag(name: str, value: object) -> None:
    """Raises where a value that switches something is none.

    Raises:
        TypeError: Neither ``True`` nor ``False``, nor 1 or 0.
    """
    if isinstance(value, (bool, np.bool_)):
        return
    if not isinstance(value, (int, np.integer)) or value not in (0, 1):
        raise TypeError(f"{name}={value!r}: allowed: True, False")


def check_count(
    name: str, value: object, least: int = 1, most: int = 2**31 - 1
) -> None:
    """Raises where a number of things is none.

    Args:
        name: Name of the option.
        value: What was given.
        least: Smallest that is allowed.
        most: Largest; by default what JAX counts with.

    Raises:
        ValueError: It is no integer, or out of its range.
    """
    integer = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not integer or not least <= value <= most:  # pyright: ignore
        raise ValueError(f"{name}={value!r}: allowed: integers from {least} to {most}")


def check_positive(
    name: str, value: object, *, endless: bool = False, optional: bool = False
) -> None:
    """Raises where a number is not above 0.

    Args:
        name: Name of the option.
        value: What was given.
        endless: Whether it may be infinite.
        optional: Whether it may be ``None``.

    Raises:
        TypeError: It is no number.
        ValueError: It is not above 0, or infinite.
    """
    allowed = f"a {'' if endless else 'finite '}number above 0"
    allowed = f"allowed: {'None, or ' if optional else ''}{allowed}"
    if optional and value is None:
        return
    if not is_number(value):
        raise TypeError(f"{name}={value!r}: {allowed}")
    if not value > 0 or (value == math.inf and not endless):
        raise ValueError(f"{name}={value!r}: {allowed}")


def float_type(dtype: DTypeLike) -> np.dtype:
    """The type that an environment computes in.

    Raises:
        ValueError: It is neither float32 nor float64.
    """
    try:
        found = np.dtype(dtype)
    except TypeError:
        found = None
    if found is None or found not in (np.float32, np.float64):
        raise ValueError(f"dtype={dtype!r}: allowed: 'float32', 'float64'")
    return found


def is_number(value: object) -> TypeGuard[float]:
    """Returns whether a value is a real number; ``True`` and ``False`` are none."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


_CHECKS: dict[str, Callable[[str, object], None]] = {
    "float": check_number,
    "tuple[float, float]": _range,
    "bool": check_flag,
}
