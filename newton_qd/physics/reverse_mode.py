"""Errors for derivatives that a kernel does not have; they say what to use instead.

A kernel has an adjoint, but no forward derivative, and the adjoint has no derivative.
JAX's own errors for this name neither the cause nor the cure. Two primitives stand
before the kernel: the identity, and its tangent. The way back passes the tangent
unchanged. Only forward mode computes it. The adjoint has a rule of its own for its way
back, which refuses. So a gradient that is only a constant of another one is allowed.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

_FORWARD = (
    "can't apply forward-mode autodiff (jvp) to a custom_vjp function: the physics has "
    "first derivatives in reverse mode only; use jax.grad, jax.vjp or jax.jacrev "
    "instead of jax.jvp, jax.jacfwd or jax.hessian (docs/physics.md)"
)

_SECOND = (
    "the physics has first derivatives only: a gradient of it cannot be differentiated "
    "again; stop the inner gradient with jax.lax.stop_gradient, or use differences of "
    "gradients (docs/physics.md)"
)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def without_derivative(name: str, x: jax.Array) -> jax.Array:
    """Returns ``x`` unchanged. Any derivative of it is a ``TypeError``.

    Args:
        name: Name of the function that reads ``x`` and has no derivative.
        x: Its inputs.
    """
    return x


@functools.partial(without_derivative.defjvp, symbolic_zeros=True)
def _constant(name: str, primals: tuple, tangents: tuple) -> tuple[Any, Any]:
    """Passes what is constant.

    Raises:
        TypeError: ``x`` is differentiated.
    """
    if not isinstance(tangents[0], SymbolicZero):
        raise TypeError(
            f"there is no derivative of {name}: stop the gradient of its arguments "
            "with jax.lax.stop_gradient, or use differences of its values "
            "(docs/physics.md)"
        )
    return primals[0], tangents[0]


def reverse_mode_only(x: jax.Array) -> jax.Array:
    """Returns ``x`` unchanged. Its derivative in forward mode is a ``TypeError``."""
    return _same.bind(x)


def first_derivatives_only(
    adjoint: Callable[..., jax.Array],
) -> Callable[..., jax.Array]:
    """Returns a function of rows. Its derivative, where used, is a ``TypeError``."""

    @jax.custom_vjp
    def run(*rows: jax.Array) -> jax.Array:
        return adjoint(*rows)

    def refuse(_: None, cotangent: jax.Array) -> Any:
        raise TypeError(_SECOND)

    run.defvjp(lambda *rows: (run(*rows), None), refuse)
    return lambda *rows: run(*map(reverse_mode_only, rows))


def _refuse(*arguments: object, **options: object) -> Any:
    """Refuses to compute a tangent.

    Raises:
        TypeError: Always.
    """
    raise TypeError(_FORWARD)


def _differentiated(primals: tuple, tangents: tuple) -> tuple[Any, Any]:
    (x,), (tangent,) = primals, tangents
    if not isinstance(tangent, ad.Zero):
        tangent = _tangent.bind(tangent)
    return _same.bind(x), tangent


_same = Primitive("newton_qd_reverse_mode_only")
_same.def_abstract_eval(lambda x: x)
_same.def_impl(lambda x: x)
mlir.register_lowering(_same, lambda context, x: [x])
batching.primitive_batchers[_same] = lambda arguments, axes: (
    _same.bind(*arguments),
    axes[0],
)
ad.primitive_jvps[_same] = _differentiated

_tangent = Primitive("newton_qd_tangent")
_tangent.def_abstract_eval(lambda x: x)
# All these run in forward mode only.
_tangent.def_impl(_refuse)
mlir.register_lowering(_tangent, _refuse)
batching.primitive_batchers[_tangent] = _refuse
ad.primitive_jvps[_tangent] = _refuse
ad.primitive_transposes[_tangent] = lambda cotangent, _: (cotangent,)
