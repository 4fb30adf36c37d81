"""Functions of one number for each world of a pack."""

import warp as wp

from .. import real, scalar
from .native import PRELUDE, native

ROOT = """
#if defined(__CUDA_ARCH__)
auto root = [](Real x) { return wp::sqrt(x); };
#else
auto root = [](Real x) { return __builtin_elementwise_sqrt(x); };
#endif
"""


@wp.func_native(*native("root(A)", "adj_A += adj_RET / (RET + RET);", ROOT))
def sqrt(a: real) -> real:
    """Square root of a positive number."""
    ...


@wp.func_native(*native("Real(s)"))
def uniform(s: scalar) -> real:
    """One number for all worlds."""
    ...


@wp.func_native(
    *native(
        "A < B ? B : (C < A ? C : A)",
        """
Real zero = Real(0);
adj_B += A < B ? adj_RET : zero;
adj_C += A < B ? zero : (C < A ? adj_RET : zero);
adj_A += A < B ? zero : (C < A ? zero : adj_RET);
""",
    )
)
def clamp(a: real, b: real, c: real) -> real:
    """``a`` between ``b`` and ``c``."""
    ...


@wp.func_native(
    *native(
        "A < bound ? (A > -bound ? zero : one) : one",
        before="Real zero = Real(0), one = Real(1), bound = Real(s);",
    )
)
def beyond(a: real, s: scalar) -> real:
    """0 where a number lies between ``-s`` and ``s``, else 1; without adjoint."""
    ...


@wp.func_native(
    *native(
        "A > bound ? one : zero",
        before="Real zero = Real(0), one = Real(1), bound = Real(s);",
    )
)
def above(a: real, s: scalar) -> real:
    """1 where a number is above ``s``, else 0; without adjoint."""
    ...


@wp.func_native(
    *native(
        "C != zero ? A : B",
        """
adj_A += C != zero ? adj_RET : zero;
adj_B += C != zero ? zero : adj_RET;
""",
        "Real zero = Real(0);",
    )
)
def choose(c: real, a: real, b: real) -> real:
    """``a`` where ``c`` is not 0, else ``b``."""
    ...


ANY = """
#if defined(__CUDA_ARCH__)
auto any = [](Real x) { return x != Real(0); };
#else
auto any = [](Real x) { return __builtin_reduce_or(x != Real(0)) != 0; };
#endif
"""


@wp.func_native(
    snippet=f"{PRELUDE}{ANY}return any(Convert::in(a));",
    adj_snippet="",
)
def occurs(a: real) -> int:
    """1 if a number is not 0 in some world of the pack, else 0; without adjoint."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
return __syncthreads_or(count);
#else
return count;
#endif
""",
    adj_snippet="",
)
def occurs_beside(count: int) -> int:
    """Not 0 if ``count`` is not 0 in some world of the block, or of a CPU's pack.

    All threads of a block call it together, and get the same answer: they may branch on
    it and wait for each other inside. Without adjoint.
    """
    ...
