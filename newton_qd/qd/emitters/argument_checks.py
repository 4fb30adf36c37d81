"""Checks of arguments that several emitters have."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import optax

from newton_qd import checks
from newton_qd.checks import message


def check_optimizer(optimizer: optax.GradientTransformation) -> None:
    """Checks that an optimizer is one of optax.

    Raises:
        TypeError: It is not.
    """
    kind, allowed = optax.GradientTransformation, "one of optax, such as optax.adam"
    checks.instance("optimizer", optimizer, kind, allowed)


def check_range(name: str, value: object) -> None:
    """Checks that a value is a range of sizes.

    Raises:
        TypeError: It is not two numbers.
        ValueError: A number is not finite and above 0, or the first is the larger one.
    """
    allowed, ends = "two numbers, 0 < smallest <= largest", cast("Any", value)
    if isinstance(value, np.ndarray):
        ends = value.tolist()
    if not isinstance(ends, tuple | list) or len(ends) != 2:
        raise TypeError(message(name, value, allowed))
    for index, end in enumerate(ends):
        checks.number(f"{name}[{index}]", end, above=0)
    if ends[0] > ends[1]:
        raise ValueError(message(name, value, allowed))
