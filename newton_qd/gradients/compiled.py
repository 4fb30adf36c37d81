"""Methods that are compiled once for each object, also where the caller does not."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from newton_qd.physics.explicit_mesh import mesh_of
from newton_qd.physics.parameters import check_values

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")
_NUMBERS = (jax.Array, np.ndarray, np.generic, bool, int, float)


def compiled_once(
    method: Callable[_Arguments, _Result],
) -> Callable[_Arguments, _Result]:
    """Compiles a pure method, unless a function that calls it is being compiled.

    Without this, each call outside of :func:`jax.jit` would be compiled again, because
    the loop inside is a new one for JAX.

    Args:
        method: Method of an immutable object. Its arguments are pytrees of arrays.
            Those that are keyword-only are constants with their value in the ``repr``.
    """
    signature = inspect.signature(method)

    @functools.wraps(method)
    def run(*given: Any, **named: Any) -> Any:
        bound = signature.bind(*given, **named)
        (this, *arguments), options = bound.args, bound.kwargs
        if _compiling():
            with mesh_of(arguments):
                return method(*given, **named)
        if not _arrays_only(arguments):
            return method(*given, **named)
        for argument in arguments:  # inside, the values are not known
            check_values(argument)
        kept = this.__dict__.setdefault(_KEPT, {})
        key = (method.__name__, repr(sorted(options.items())))
        if key not in kept:
            kept[key] = jax.jit(functools.partial(method, this, **options))
        return kept[key](*arguments)

    return run


_KEPT = "_compiled"


def without_compiled(state: dict[str, Any]) -> dict[str, Any]:
    """Returns the attributes of an object that pickle stores."""
    return {name: value for name, value in state.items() if name != _KEPT}


def _compiling() -> bool:
    """Returns whether operations are recorded for a function to be compiled."""
    return isinstance(jnp.zeros((), jnp.float32), Tracer)


def _arrays_only(arguments: list[Any]) -> bool:
    """Returns whether JAX takes the arguments; the method names what is wrong."""
    return all(isinstance(leaf, _NUMBERS) for leaf in jax.tree.leaves(arguments))
