"""What the functions of this package refuse, in the same words."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from newton_qd.envs.options import is_number


def check_integer(name: str, value: Any, low: int, high: int = 2**31 - 1) -> None:
    """Raises where a number of things is none.

    Args:
        name: Name of the argument.
        value: What was given.
        low: Smallest that is allowed.
        high: Largest; by default what JAX counts with.

    Raises:
        ValueError: It is no integer, or out of its range.
    """
    integer = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not integer or not low <= value <= high:
        raise ValueError(f"{name}={value!r}: allowed: integers from {low} to {high}")


def check_positive(name: str, value: Any, *, endless: bool = False) -> None:
    """Raises where a number is not above 0.

    Args:
        name: Name of the argument.
        value: What was given.
        endless: Whether it may be infinite.

    Raises:
        TypeError: It is no number.
        ValueError: It is not above 0, or infinite.
    """
    allowed = f"allowed: {'' if endless else 'finite '}numbers above 0"
    if not is_number(value):
        raise TypeError(f"{name}={value!r}: {allowed}")
    if not value > 0 or (value == math.inf and not endless):
        raise ValueError(f"{name}={value!r}: {allowed}")
