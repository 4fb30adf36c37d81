"""An error for forward mode that says what to use instead.

A kernel has an adjoint, but no forward derivative. JAX's own error for this names
neither the cause nor the cure. Two primitives stand before the kernel: the identity,
and its tangent. The way back passes the tangent unchanged. Only forward mode computes
it.
"""

from __future__ import annotations

from typing import Any

import jax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

_FORWARD = (
    "can't apply forward-mode autodiff (jvp) to a custom_vjp function: the physics has "
    "first derivatives in reverse mode only; use jax.grad, jax.vjp or jax.jacrev "
    "instead of jax.jvp, jax.jacfwd or jax.hessian (docs/gradients.md)"
)


def reverse_mode_only(x: jax.Array) -> jax.Array:
    """Returns ``x`` unchanged. Its derivative in forward mode is a ``TypeError``."""
    return _same.bind(x)


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


def _batched(arguments: tuple, axes: tuple) -> tuple[Any, Any]:
    return _same.bind(*arguments), axes[0]


_same = Primitive("newton_qd_reverse_mode_only")
_same.def_abstract_eval(lambda x: x)
_same.def_impl(lambda x: x)
mlir.register_lowering(_same, lambda context, x: [x])
batching.primitive_batchers[_same] = _batched
ad.primitive_jvps[_same] = _differentiated

_tangent = Primitive("newton_qd_tangent")
_tangent.def_abstract_eval(lambda x: x)
# All these run in forward mode only.
_tangent.def_impl(_refuse)
mlir.register_lowering(_tangent, _refuse)
batching.primitive_batchers[_tangent] = _refuse
ad.primitive_transposes[_tangent] = lambda cotangent, _: (cotangent,)
