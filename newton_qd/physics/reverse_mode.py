"""Errors for derivatives that a kernel does not have; they say what to use instead.

A kernel has an adjoint, but no forward derivative, and the adjoint has no derivative.
JAX's own errors for this name neither the cause nor the cure. Two primitives stand
before the kernel: the identity, and its tangent. The way back passes the tangent
unchanged. Only forward mode computes it. Another identity stands before the adjoint. It
refuses any tangent.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

_FORWARD = (
    "can't apply forward-mode autodiff (jvp) to a custom_vjp function: the physics has "
    "first derivatives in reverse mode only; use jax.grad, jax.vjp or jax.jacrev "
    "instead of jax.jvp, jax.jacfwd or jax.hessian (docs/physics.md)"
)

_SECOND = (
    "the physics has first derivatives only: a gradient of it cannot be differentiated "
    "again; take the inner gradient at jax.lax.stop_gradient(x), or use differences of "
    "gradients (docs/physics.md)"
)


def reverse_mode_only(x: jax.Array) -> jax.Array:
    """Returns ``x`` unchanged. Its derivative in forward mode is a ``TypeError``."""
    return _same.bind(x)


def first_derivatives_only(x: jax.Array) -> jax.Array:
    """Returns ``x`` unchanged. Its derivative is a ``TypeError``."""
    return _first.bind(x)


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


def _differentiated_again(primals: tuple, tangents: tuple) -> Any:
    """Refuses to differentiate an adjoint.

    Raises:
        TypeError: Always.
    """
    raise TypeError(_SECOND)


def _identity(name: str, differentiated: Callable[[tuple, tuple], Any]) -> Primitive:
    """Returns an identity with a derivative of its own."""
    same = Primitive(name)
    same.def_abstract_eval(lambda x: x)
    same.def_impl(lambda x: x)
    mlir.register_lowering(same, lambda context, x: [x])
    batching.primitive_batchers[same] = lambda arguments, axes: (
        same.bind(*arguments),
        axes[0],
    )
    ad.primitive_jvps[same] = differentiated
    return same


_same = _identity("newton_qd_reverse_mode_only", _differentiated)
_first = _identity("newton_qd_first_derivatives_only", _differentiated_again)

_tangent = Primitive("newton_qd_tangent")
_tangent.def_abstract_eval(lambda x: x)
# All these run in forward mode only.
_tangent.def_impl(_refuse)
mlir.register_lowering(_tangent, _refuse)
batching.primitive_batchers[_tangent] = _refuse
ad.primitive_transposes[_tangent] = lambda cotangent, _: (cotangent,)
