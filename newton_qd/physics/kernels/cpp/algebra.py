"""Algebra on packs of worlds: what has no operator."""

import warp as wp

from .. import mat33, quat, real, sym33, transform, vec3
from .native import EACH, native
from .numbers import ROOT

# Vectors.


@wp.func_native(
    *native(
        "Vec3(A, B, C)",
        "adj_A += adj_RET[0]; adj_B += adj_RET[1]; adj_C += adj_RET[2];",
    )
)
def vector(a: real, b: real, c: real) -> vec3:
    """Vector of its components."""
    ...


for _type in (vec3, quat, transform):

    @wp.func_native(*native("((Real*)&A)[i]", "((Real*)&adj_A)[i] += adj_RET;"))
    def component(a: _type, i: int) -> real:
        """Component ``i``; a transform's are its translation, then its rotation."""
        ...


@wp.func_native(*native("wp::dot(A, B)", "wp::adj_dot(A, B, adj_A, adj_B, adj_RET);"))
def dot(a: vec3, b: vec3) -> real:
    """Scalar product."""
    ...


@wp.func_native(
    *native("wp::cross(A, B)", "wp::adj_cross(A, B, adj_A, adj_B, adj_RET);")
)
def cross(a: vec3, b: vec3) -> vec3:
    """Vector product."""
    ...


@wp.func_native(
    *native(
        "root(wp::dot(A, A))",
        "Real d = adj_RET / RET; for (int i = 0; i < 3; ++i) adj_A[i] += d * A[i];",
        ROOT,
    )
)
def length(a: vec3) -> real:
    """Length of a vector that is not zero."""
    ...


for _type in (vec3, quat):

    @wp.func_native(
        *native(
            "each(A, A, [d](Real x, Real) { return d * x; })",
            "Real along = wp::dot(RET, adj_RET);"
            "auto across = "
            "each(adj_RET, RET, [&](Real x, Real y) { return x - along * y; });"
            "adj_A = each(adj_A, across, [d](Real x, Real y) { return x + d * y; });",
            EACH + ROOT + "Real d = Real(1) / root(wp::dot(A, A));",
        )
    )
    def normalize(a: _type) -> _type:
        """``a``, which is not zero, divided by its length."""
        ...


# 3 x 3 matrices.


@wp.func_native(
    *native("wp::transpose(A)", "adj_A = wp::add(adj_A, wp::transpose(adj_RET));")
)
def transpose(a: mat33) -> mat33:
    """Transpose."""
    ...


@wp.func_native(
    *native("wp::outer(A, B)", "wp::adj_outer(A, B, adj_A, adj_B, adj_RET);")
)
def outer(a: vec3, b: vec3) -> mat33:
    """Product of a column and a row vector."""
    ...


@wp.func_native(*native("wp::skew(A)", "wp::adj_skew(A, adj_A, adj_RET);"))
def skew(a: vec3) -> mat33:
    """Matrix of the vector product with ``a`` from the left."""
    ...


@wp.func_native(
    *native(
        "sum(A, B)",
        """
adj_A = wp::add(adj_A, adj_RET);
adj_B += adj_RET.data[0][0] + adj_RET.data[1][1] + adj_RET.data[2][2];
""",
        """
auto sum = [](Mat33 x, Real y) {
    for (int i = 0; i < 3; ++i) x.data[i][i] += y;
    return x;
};
""",
    )
)
def add_diagonal(a: mat33, b: real) -> mat33:
    """``a`` plus ``b`` times the identity."""
    ...


@wp.func_native(
    *native(
        "inverse(A)",
        """
Mat33 turned = wp::transpose(RET);
adj_A = wp::sub(adj_A, wp::mul(turned, wp::mul(adj_RET, turned)));
""",
        """
auto inverse = [](const Mat33& m) {
    Vec3 x(m.data[0][0], m.data[1][0], m.data[2][0]);
    Vec3 y(m.data[0][1], m.data[1][1], m.data[2][1]);
    Vec3 z(m.data[0][2], m.data[1][2], m.data[2][2]);
    Vec3 yz = wp::cross(y, z), zx = wp::cross(z, x), xy = wp::cross(x, y);
    Real scale = Real(1) / wp::dot(x, yz);
    Mat33 result;
    for (int i = 0; i < 3; ++i) {
        result.data[0][i] = scale * yz[i];
        result.data[1][i] = scale * zx[i];
        result.data[2][i] = scale * xy[i];
    }
    return result;
};
""",
    )
)
def inverse(a: mat33) -> mat33:
    """Inverse of a regular matrix."""
    ...


# Symmetric 3 x 3 matrices: six numbers. The adjoint of one that is there twice is that
# of both.


@wp.func_native(
    *native(
        "part(A)",
        """
adj_A.data[0][0] += adj_RET.xx;
adj_A.data[0][1] += adj_RET.xy;
adj_A.data[0][2] += adj_RET.xz;
adj_A.data[1][1] += adj_RET.yy;
adj_A.data[1][2] += adj_RET.yz;
adj_A.data[2][2] += adj_RET.zz;
""",
        """
auto part = [](const Mat33& m) {
    return Sym33{m.data[0][0], m.data[0][1], m.data[0][2],
                 m.data[1][1], m.data[1][2], m.data[2][2]};
};
""",
    )
)
def symmetric(a: mat33) -> sym33:
    """Six numbers of a matrix that is symmetric up to rounding."""
    ...


_PARALLEL = """
auto parallel = [](const Vec3& x, const Vec3& y) {
    return Sym33{x[0] * y[0], x[0] * y[1], x[0] * y[2],
                 x[1] * y[1], x[1] * y[2], x[2] * y[2]};
};
"""


@wp.func_native(
    *native(
        "parallel(A, B)",
        """
adj_A[0] += adj_RET.xx * B[0] + adj_RET.xy * B[1] + adj_RET.xz * B[2];
adj_A[1] += adj_RET.yy * B[1] + adj_RET.yz * B[2];
adj_A[2] += adj_RET.zz * B[2];
adj_B[0] += adj_RET.xx * A[0];
adj_B[1] += adj_RET.xy * A[0] + adj_RET.yy * A[1];
adj_B[2] += adj_RET.xz * A[0] + adj_RET.yz * A[1] + adj_RET.zz * A[2];
""",
        _PARALLEL,
    )
)
def parallel(a: vec3, b: vec3) -> sym33:
    """Product of a column and a row vector that are parallel."""
    ...


@wp.func_native(
    *native(
        "Sym33{x.xx, x.xy + y.xy, x.xz + y.xz, x.yy, x.yz + y.yz, x.zz}",
        before=_PARALLEL + "Sym33 x = parallel(A, B), y = parallel(B, A);",
    )
)
def form_slope(a: vec3, b: vec3) -> sym33:
    """Derivative of a . S b with respect to a symmetric S; without adjoint."""
    ...


@wp.func_native(
    *native(
        "sum(A, B)",
        """
adj_A.xx += adj_RET.xx;
adj_A.xy += adj_RET.xy;
adj_A.xz += adj_RET.xz;
adj_A.yy += adj_RET.yy;
adj_A.yz += adj_RET.yz;
adj_A.zz += adj_RET.zz;
adj_B += adj_RET.xx + adj_RET.yy + adj_RET.zz;
""",
        """
auto sum = [](Sym33 x, Real y) {
    x.xx += y;
    x.yy += y;
    x.zz += y;
    return x;
};
""",
    )
)
def add_diagonal(a: sym33, b: real) -> sym33:
    """``a`` plus ``b`` times the identity."""
    ...


@wp.func_native(
    *native(
        "inverse(A)",
        before="""
auto inverse = [](const Sym33& m) {
    Real xx = m.yy * m.zz - m.yz * m.yz;
    Real xy = m.xz * m.yz - m.xy * m.zz;
    Real xz = m.xy * m.yz - m.xz * m.yy;
    Real scale = Real(1) / (m.xx * xx + m.xy * xy + m.xz * xz);
    return Sym33{scale * xx, scale * xy, scale * xz,
                 scale * (m.xx * m.zz - m.xz * m.xz),
                 scale * (m.xy * m.xz - m.xx * m.yz),
                 scale * (m.xx * m.yy - m.xy * m.xy)};
};
""",
    )
)
def inverse(a: sym33) -> sym33:
    """Inverse of a regular symmetric matrix; without adjoint."""
    ...


# Rotations and rigid transforms.


@wp.func_native(
    *native(
        "Quat(A, B, C, D)",
        """
adj_A += adj_RET.x;
adj_B += adj_RET.y;
adj_C += adj_RET.z;
adj_D += adj_RET.w;
""",
    )
)
def quaternion(a: real, b: real, c: real, d: real) -> quat:
    """Quaternion of its components, the real part last."""
    ...


@wp.func_native(
    *native(
        "wp::quat_rotate(A, B)",
        "wp::adj_quat_rotate(A, B, adj_A, adj_B, adj_RET);",
    )
)
def rotate(a: quat, b: vec3) -> vec3:
    """A vector, rotated."""
    ...


@wp.func_native(
    *native(
        "wp::quat_rotate_inv(A, B)",
        "wp::adj_quat_rotate_inv(A, B, adj_A, adj_B, adj_RET);",
    )
)
def rotate_back(a: quat, b: vec3) -> vec3:
    """A vector, rotated by the inverse."""
    ...


@wp.func_native(
    *native("wp::quat_to_matrix(A)", "wp::adj_quat_to_matrix(A, adj_A, adj_RET);")
)
def matrix(a: quat) -> mat33:
    """Matrix of a rotation."""
    ...


@wp.func_native(
    *native(
        "Transform(A, B)",
        "adj_A = wp::add(adj_A, adj_RET.p); adj_B = wp::add(adj_B, adj_RET.q);",
    )
)
def rigid(a: vec3, b: quat) -> transform:
    """Transform of its translation and rotation."""
    ...


@wp.func_native(*native("A.p", "adj_A.p = wp::add(adj_A.p, adj_RET);"))
def translation(a: transform) -> vec3:
    """Translation of a transform."""
    ...


@wp.func_native(*native("A.q", "adj_A.q = wp::add(adj_A.q, adj_RET);"))
def rotation(a: transform) -> quat:
    """Rotation of a transform."""
    ...


@wp.func_native(
    *native(
        "wp::transform_point(A, B)",
        "wp::adj_transform_point(A, B, adj_A, adj_B, adj_RET);",
    )
)
def transform_point(a: transform, b: vec3) -> vec3:
    """A point, transformed."""
    ...
