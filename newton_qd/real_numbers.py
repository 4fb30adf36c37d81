"""Tells real numbers from text, truth values, complex numbers and other objects."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from newton_qd.checks import Fact, is_array, message


def real_numbers(value: object) -> np.ndarray | None:
    """Returns numbers as an array, float64; ``None`` if they are no real numbers.

    Text such as ``"1"`` is no number, though NumPy would convert it. Neither are
    ``True`` and ``False``.
    """
    try:
        found = np.asarray(value)
    except (TypeError, ValueError):  # rows of several lengths, a value under ``jit``
        return None
    kinds = (jnp.integer, jnp.floating)  # of NumPy, and such as bfloat16
    real = any(jnp.issubdtype(found.dtype, kind) for kind in kinds)
    return found.astype(np.float64) if real else None


def require_real(name: str, value: object) -> None:
    """Checks that an array or a number is real; a truth value counts as a number.

    Raises:
        TypeError: It is no array and no number, or has complex numbers.
    """
    allowed = "real numbers"
    scalars = (bool, int, float, np.bool_, np.number)
    if not is_array(value) and not isinstance(value, scalars):
        given = Fact("None" if value is None else f"a {type(value).__name__}")
        raise TypeError(message(name, given, allowed))
    if jnp.issubdtype(jnp.result_type(value), jnp.complexfloating):
        raise TypeError(message(name, Fact("complex numbers"), allowed))
