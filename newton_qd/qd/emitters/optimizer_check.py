"""A check of the optimizer of an emitter."""

from __future__ import annotations

import optax

from newton_qd import checks


def check_optimizer(optimizer: optax.GradientTransformation) -> None:
    """Checks that an optimizer is one of optax.

    Raises:
        TypeError: It is not.
    """
    kind, allowed = optax.GradientTransformation, "one of optax, such as optax.adam"
    checks.instance("optimizer", optimizer, kind, allowed)
