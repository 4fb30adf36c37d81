"""Checks of arguments. All errors read NAME: got VALUE; allowed: WHAT.

A check returns ``None`` for an allowed value. It raises ``TypeError`` for a wrong type
and ``ValueError`` for a wrong value. If a caller gives ``error``, the check raises that
class for both.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Collection
from typing import TYPE_CHECKING, Any, Protocol, TypeGuard

import numpy as np

if TYPE_CHECKING:
    import jax
    from numpy.typing import DTypeLike

_LONGEST = 100  # characters of a value in an error
_MOST = 2**31 - 1  # JAX counts in 32 bits
_NAME = 100  # characters of a name that becomes a file
_FLOATS = ("float32", "float64")

Error = type[Exception]


class _Array(Protocol):
    @property
    def shape(self) -> tuple[int, ...]: ...

    @property
    def dtype(self) -> object: ...


class Fact(str):
    """Words in the place of a value in an error, such as ``"3 entries"``."""

    __slots__ = ()
    __repr__ = str.__str__


def message(name: str, value: object, allowed: str, *, why: str = "") -> str:
    """Returns the text of an error about an argument.

    Args:
        name: Name of the argument, or of a part of it, that the caller knows.
        value: The wrong value, or a :class:`Fact` that describes it.
        allowed: Description of the allowed values.
        why: The reason why the value is wrong, if ``allowed`` is not enough.
    """
    got = f"{shown(value)}, {why}" if why else shown(value)
    return f"{name}: got {got}; allowed: {allowed}"


def shown(value: object) -> str:
    """Returns the text of a value in errors: the shape of an array, long text cut."""
    if isinstance(value, Fact):
        return value
    if is_array(value):
        return f"an array of shape {tuple(value.shape)}, {value.dtype}"
    text = repr(value)
    if len(text) <= _LONGEST and "\n" not in text:
        return text
    text = " ".join(text.split())
    cut = f"{text[: _LONGEST - 3]}..." if len(text) > _LONGEST else text
    return f"{cut} ({type(value).__name__})"


def listed(names: Collection[object], otherwise: str = "none") -> str:
    """Returns the text of a list of names in errors; ``otherwise`` if it is empty."""
    return ", ".join(str(name) for name in names) or otherwise


def is_array(value: object) -> TypeGuard[_Array]:
    """Returns whether a value is an array of NumPy or JAX, traced or not."""
    if isinstance(value, (type, np.generic)):
        return False
    return hasattr(value, "shape") and hasattr(value, "dtype")


def is_number(value: object) -> TypeGuard[float]:
    """Returns whether a value is a real number; ``True`` and ``False`` are not."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def is_integer(value: object) -> TypeGuard[int]:
    """Returns whether a value is of an integer type; ``True`` and ``False`` are not."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def number(
    name: str,
    value: object,
    *,
    least: float | None = None,
    above: float | None = None,
    most: float | None = None,
    below: float | None = None,
    endless: bool = False,
    optional: bool = False,
    error: Error | None = None,
) -> None:
    """Checks that a value is a real number within bounds.

    Args:
        name: Name of the argument.
        value: Value of the argument.
        least: Smallest allowed number.
        above: Lower bound; the bound itself is not allowed.
        most: Largest allowed number.
        below: Upper bound; the bound itself is not allowed.
        endless: Whether infinite numbers are allowed.
        optional: Whether ``None`` is allowed.
        error: Class to raise instead of both.

    Raises:
        TypeError: The value is not a number.
        ValueError: The value is NaN, infinite or out of bounds.
    """
    if optional and value is None:
        return
    numeric = is_number(value)
    if (
        numeric
        and (_finite(value) or (endless and abs(value) == math.inf))
        and (least is None or value >= least)
        and (above is None or value > above)
        and (most is None or value <= most)
        and (below is None or value < below)
    ):
        return
    bounded = (least, above) != (None, None) and (most, below) != (None, None)
    kind = "numbers" if endless or bounded else "finite numbers"
    allowed = _none(optional) + kind + _bounds(least, above, most, below)
    raise (error or (ValueError if numeric else TypeError))(
        message(name, value, allowed)
    )


def integer(
    name: str,
    value: object,
    *,
    least: int | None = 1,
    most: int | None = _MOST,
    optional: bool = False,
    error: Error = ValueError,
) -> None:
    """Checks that a value is an integer within bounds.

    ``2.0``, ``"2"`` and ``0`` are all wrong values and raise the same class.

    Args:
        name: Name of the argument.
        value: Value of the argument.
        least: Smallest allowed integer; ``None``: no bound.
        most: Largest allowed integer; by default the largest index of JAX. ``None``: no
            bound.
        optional: Whether ``None`` is allowed.
        error: Class to raise.

    Raises:
        ValueError: The value is not an integer, or is out of bounds.
    """
    if optional and value is None:
        return
    if (
        is_integer(value)
        and (least is None or value >= least)
        and (most is None or value <= most)
    ):
        return
    allowed = _none(optional) + "integers" + _bounds(least, None, most, None)
    raise error(message(name, value, allowed))


def interval(name: str, value: object, *, error: Error | None = None) -> None:
    """Checks that a value is two numbers, the first below the second.

    Raises:
        TypeError: The value is not two numbers.
        ValueError: The first is not below the second.
    """
    ends: Any = value
    pair = isinstance(ends, (tuple, list, np.ndarray)) and len(ends) == 2
    numeric = pair and all(is_number(end) for end in ends)
    if not numeric or not ends[0] < ends[1]:
        raise (error or (ValueError if numeric else TypeError))(
            message(name, value, "two numbers, lowest below highest")
        )


def flag(name: str, value: object, *, error: Error = TypeError) -> None:
    """Checks that a value is ``True``, ``False``, 1 or 0.

    Raises:
        TypeError: The value is none of these.
    """
    if not isinstance(value, (bool, np.bool_, int, np.integer)) or value not in (0, 1):
        raise error(message(name, value, "True, False"))


def text(
    name: str, value: object, *, optional: bool = False, error: Error = ValueError
) -> None:
    """Checks that a value is text and not empty.

    Raises:
        ValueError: The value is not text, or is empty.
    """
    if not (optional and value is None) and not (isinstance(value, str) and value):
        raise error(message(name, value, f"{_none(optional)}text that is not empty"))


def identifier(
    name: str, value: object, *, optional: bool = False, error: Error = ValueError
) -> None:
    """Checks that a value is a short name of ASCII characters, so never a path.

    Raises:
        ValueError: The value is not text, is empty, is too long, or has other
            characters.
    """
    text(name, value, optional=optional, error=error)
    if not isinstance(value, str):
        return
    # accents have two encodings, which some file systems mix up
    if not (value.isidentifier() and value.isascii() and len(value) <= _NAME):
        allowed = "letters, digits and _ of ASCII, not beginning with a digit, up to "
        allowed += f"{_NAME} characters"
        raise error(message(name, value, allowed))


def choice(name: str, value: object, allowed: Collection[str]) -> None:
    """Checks that a value is one of several names.

    Args:
        name: Name of the argument.
        value: Value of the argument.
        allowed: The names.

    Raises:
        ValueError: The value is none of them.
    """
    if not isinstance(value, str) or value not in allowed:
        raise ValueError(message(name, value, listed(allowed)))


def instance(
    name: str,
    value: object,
    kinds: type | tuple[type, ...],
    allowed: str,
    *,
    optional: bool = False,
    error: Error | None = None,
) -> None:
    """Checks that a value is an instance of a class.

    Args:
        name: Name of the argument.
        value: Value of the argument.
        kinds: Allowed classes.
        allowed: Description of these classes.
        optional: Whether ``None`` is allowed.
        error: Class to raise instead.

    Raises:
        TypeError: The value is an instance of another class.
    """
    if not (optional and value is None) and not isinstance(value, kinds):
        raise (error or TypeError)(message(name, value, _none(optional) + allowed))


def function(name: str, value: object, allowed: str, *, optional: bool = False) -> None:
    """Checks that a value can be called.

    Raises:
        TypeError: The value cannot be called.
    """
    if not (optional and value is None) and not callable(value):
        raise TypeError(message(name, value, _none(optional) + allowed))


def environment(value: object, *, needs: str = "step") -> None:
    """Checks that ``env`` is an environment: it must have the attribute ``needs``.

    Raises:
        TypeError: It has no such attribute, or is a class.
    """
    if isinstance(value, type) or not hasattr(value, needs):
        raise TypeError(message("env", value, "an environment, as create() makes it"))


def precision(dtype: DTypeLike) -> np.dtype:
    """Returns the dtype of a simulation.

    Raises:
        ValueError: It is not float32 or float64, or it is float64 and JAX x64 is off.
    """
    try:
        found = None if dtype is None else np.dtype(dtype)  # NumPy takes it as float64
    except TypeError:
        found = None
    if found is None or found.name not in _FLOATS:
        raise ValueError(message("dtype", dtype, listed(_FLOATS)))
    x64(found)
    return found


def x64(dtype: np.dtype) -> None:
    """Checks that JAX would not silently round float64 to float32.

    Raises:
        ValueError: ``dtype`` is float64 and JAX x64 is off.
    """
    import jax

    if dtype == np.float64 and not jax.config.read("jax_enable_x64"):
        raise ValueError(
            message(
                "dtype",
                Fact("'float64' while JAX x64 is off"),
                "'float32', or jax.config.update('jax_enable_x64', True) at the start",
            )
        )


def array(
    name: str,
    value: object,
    shape: tuple[int, ...],
    dtype: DTypeLike,
    *,
    scalars: bool = False,
) -> jax.Array:
    """Checks shape and dtype of an array, and returns it strongly typed.

    Args:
        name: Name of the argument.
        value: Value of the argument.
        shape: Allowed shape.
        dtype: Allowed dtype. Weakly typed numbers are converted to it.
        scalars: Whether Python's numbers and weakly typed integers are allowed.

    Raises:
        TypeError: The value is not an array, or has the wrong dtype.
        ValueError: The value has the wrong shape.
    """
    import jax
    import jax.numpy as jnp
    from jax.core import Tracer

    dtype = np.dtype(dtype)
    allowed = f"an array of shape {shape}, {dtype}"
    kinds = (jax.Array, np.ndarray)
    instance(
        name, value, (*kinds, np.generic, int, float) if scalars else kinds, allowed
    )
    try:
        found: Any = jnp.asarray(value)
    except TypeError:  # a dtype that only NumPy has, such as object
        raise TypeError(message(name, value, allowed)) from None
    kind = jnp.number if scalars else jnp.floating
    weak = found.weak_type and jnp.issubdtype(found.dtype, kind)
    if found.dtype != dtype and not weak:
        if isinstance(found, Tracer) and found.shape == shape:
            # under ``vmap``, the shape of one world would not be what the user sees
            found, allowed = Fact(f"an array of {found.dtype}"), f"an array of {dtype}"
        raise TypeError(message(name, found, allowed))
    if found.shape != shape:
        batch = " (for a batch, use jax.vmap or create(..., batch_size=...))"
        raise ValueError(message(name, found, allowed + batch))
    return found.astype(dtype)


def _finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer above the largest floating-point number
        return False


def _none(optional: bool) -> str:
    return "None, or " if optional else ""


def _bounds(least: Any, above: Any, most: Any, below: Any) -> str:
    """Returns bounds in words, such as ``" from 0, below 1"``."""
    low = f" from {least}" if least is not None else ""
    low = f" above {above}" if above is not None else low
    if most is not None:
        return f"{low} to {most}" if low.startswith(" from") else f"{low} up to {most}"
    if below is not None:
        return f"{low}{',' if low else ''} below {below}"
    return low
