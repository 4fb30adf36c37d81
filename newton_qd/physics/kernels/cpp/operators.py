"""The operators ``+ - * /`` on packs of worlds.

Warp calls ``add``, ``sub``, ``mul``, ``div`` and ``neg`` for the operators of a file
that imports them, and its own where none of these fits.
"""

import warp as wp

from .. import mat33, quat, real, scalar, sym33, transform, vec3
from .native import EACH, native

for _type in (real, vec3, mat33, sym33):

    @wp.func_native(
        *native(
            "each(A, B, plus)",
            "adj_A = each(adj_A, adj_RET, plus); adj_B = each(adj_B, adj_RET, plus);",
            EACH,
        )
    )
    def add(a: _type, b: _type) -> _type:
        """Sum."""
        ...

    @wp.func_native(
        *native(
            "each(A, B, minus)",
            "adj_A = each(adj_A, adj_RET, plus); adj_B = each(adj_B, adj_RET, minus);",
            EACH,
        )
    )
    def sub(a: _type, b: _type) -> _type:
        """Difference."""
        ...

    @wp.func_native(
        *native(
            "each(A, A, [](Real x, Real) { return -x; })",
            "adj_A = each(adj_A, adj_RET, minus);",
            EACH,
        )
    )
    def neg(a: _type) -> _type:
        """Negative."""
        ...

    # the number of all worlds has no adjoint: it comes from the model
    @wp.func_native(
        *native(
            "each(A, A, [s](Real x, Real) { return Real(s) * x; })",
            "adj_A = each(adj_A, adj_RET, "
            "[s](Real x, Real y) { return x + Real(s) * y; });",
            EACH,
        )
    )
    def mul(s: scalar, a: _type) -> _type:
        """Product with one number for all worlds."""
        ...


for _type in (vec3, mat33, sym33):

    @wp.func_native(
        *native(
            "each(A, A, [&](Real x, Real) { return B * x; })",
            "each(A, adj_RET, [&](Real x, Real y) { adj_B += x * y; return x; });"
            "adj_A = each(adj_A, adj_RET, [&](Real x, Real y) { return x + B * y; });",
            EACH,
        )
    )
    def mul(b: real, a: _type) -> _type:
        """Product with a number."""
        ...


@wp.func_native(*native("A * B", "adj_A += B * adj_RET; adj_B += A * adj_RET;"))
def mul(a: real, b: real) -> real:
    """Product."""
    ...


# their adjoints divide once
@wp.func_native(
    *native(
        "A / B",
        "Real y = Real(1) / B; Real x = adj_RET * y; adj_A += x; adj_B -= x * A * y;",
    )
)
def div(a: real, b: real) -> real:
    """Quotient."""
    ...


@wp.func_native(
    *native("Real(s) / A", "Real y = Real(1) / A; adj_A -= adj_RET * Real(s) * y * y;")
)
def div(s: scalar, a: real) -> real:
    """Quotient of one number for all worlds."""
    ...


@wp.func_native(*native("Real(s) + A", "adj_A += adj_RET;"))
def add(s: scalar, a: real) -> real:
    """Sum with one number for all worlds."""
    ...


@wp.func_native(*native("A - Real(s)", "adj_A += adj_RET;"))
def sub(a: real, s: scalar) -> real:
    """Difference from one number for all worlds."""
    ...


@wp.func_native(*native("Real(s) - A", "adj_A -= adj_RET;"))
def sub(s: scalar, a: real) -> real:
    """Difference of one number for all worlds."""
    ...


@wp.func_native(*native("wp::mul(A, B)", "wp::adj_mul(A, B, adj_A, adj_B, adj_RET);"))
def mul(a: mat33, b: vec3) -> vec3:
    """Product of a matrix and a vector."""
    ...


@wp.func_native(*native("wp::mul(A, B)", "wp::adj_mul(A, B, adj_A, adj_B, adj_RET);"))
def mul(a: mat33, b: mat33) -> mat33:
    """Product of two matrices."""
    ...


@wp.func_native(*native("wp::mul(A, B)", "wp::adj_mul(A, B, adj_A, adj_B, adj_RET);"))
def mul(a: vec3, b: mat33) -> vec3:
    """Product of a row vector and a matrix: of its transpose and the vector."""
    ...


_SYMMETRIC = """
auto full = [](const Sym33& s) {
    return Mat33(s.xx, s.xy, s.xz, s.xy, s.yy, s.yz, s.xz, s.yz, s.zz);
};
"""


@wp.func_native(
    *native(
        "wp::mul(full(A), B)",
        """
adj_B = wp::add(adj_B, wp::mul(full(A), adj_RET));
adj_A.xx += adj_RET[0] * B[0];
adj_A.yy += adj_RET[1] * B[1];
adj_A.zz += adj_RET[2] * B[2];
adj_A.xy += adj_RET[0] * B[1] + adj_RET[1] * B[0];
adj_A.xz += adj_RET[0] * B[2] + adj_RET[2] * B[0];
adj_A.yz += adj_RET[1] * B[2] + adj_RET[2] * B[1];
""",
        _SYMMETRIC,
    )
)
def mul(a: sym33, b: vec3) -> vec3:
    """Product of a symmetric matrix and a vector."""
    ...


@wp.func_native(*native("wp::mul(full(A), B)", before=_SYMMETRIC))
def mul(a: sym33, b: mat33) -> mat33:
    """Product of a symmetric matrix and a matrix; without adjoint."""
    ...


@wp.func_native(*native("wp::mul(A, full(B))", before=_SYMMETRIC))
def mul(a: mat33, b: sym33) -> mat33:
    """Product of a matrix and a symmetric one; without adjoint."""
    ...


@wp.func_native(*native("wp::mul(A, B)", "wp::adj_mul(A, B, adj_A, adj_B, adj_RET);"))
def mul(a: quat, b: quat) -> quat:
    """The rotation ``b``, then ``a``."""
    ...


@wp.func_native(
    *native(
        "wp::transform_multiply(A, B)",
        "wp::adj_transform_multiply(A, B, adj_A, adj_B, adj_RET);",
    )
)
def mul(a: transform, b: transform) -> transform:
    """The transform ``b``, then ``a``."""
    ...
