"""Smooth functions without a division by zero.

The one-sided ones are compact and twice differentiable; those of a rotation are taken
of its angle squared.
"""

import warp as wp

from .. import parametric, quat, real, scalar, vec3
from .algebra import dot
from .native import native
from .numbers import ANY, ROOT, sqrt
from .operators import add, mul, sub  # noqa: F401

# Distances are of vectors no shorter than this [m]: a direction is always finite.
SHORTEST = wp.constant(scalar(1.0e-5))

# in units of the width: its cube may be too small for a number
_ZONES = """
Real zero = Real(0), one = Real(1);
Real t = GAP / WIDTH, u = one - t, s = one + t;
auto zones = [&](Real deep, Real near) {
    return GAP <= -WIDTH ? deep : (GAP < WIDTH ? near : zero);
};
"""


@wp.func_native(
    *native(
        "zones(-GAP, Real(0.0625) * WIDTH * u * u * u * (Real(2) + s))",
        """
Real slope = Real(0.25) * u * u * (one + s);
Real widening = Real(0.1875) * u * u * s * s;
adj_GAP -= zones(one, slope) * adj_RET;
adj_WIDTH += zones(zero, widening) * adj_RET;
""",
        _ZONES,
    )
)
def penetration(gap: real, width: real) -> real:
    """Smooth ``max(-gap, 0)``: exact outside ``|gap| < width``."""
    ...


@wp.func_native(
    *native(
        "zones(one, Real(0.25) * u * u * (one + s))",
        """
Real slope = Real(0.75) * u * s / WIDTH;
Real widening = t * slope;
adj_GAP -= zones(zero, slope) * adj_RET;
adj_WIDTH += zones(zero, widening) * adj_RET;
""",
        _ZONES,
    )
)
def gate(gap: real, width: real) -> real:
    """Slope ``-d penetration / d gap``, between 0 and 1."""
    ...


@wp.func
def bounded(a: real, bound: real, rounding: real):
    """Smooth clamp of ``a`` between ``-bound`` and ``bound``."""
    return a - penetration(bound - a, rounding) + penetration(bound + a, rounding)


@wp.func
def finite_length(a: vec3):
    """Length of a vector; never less than ``SHORTEST``."""
    return sqrt(SHORTEST * SHORTEST + dot(a, a))


# Newton's method, of two steps: from the first weight, 3 % off at most. Where nothing
# is applied to any world of the pack, the weight is exactly 0, and nothing is computed.
# Nor is its slope: what is applied has none there, unless its stiffness is a parameter
# and 0.
_IDLE = "false" if parametric else "!any(APPLIED)"
_FRICTION = (
    ROOT
    + ANY
    + """
struct Weight {
    Real e, moved, mass, bound, b, inner, outer, first, w;
    // of a step
    Real y, slip, speed, share, slope, excess;
};
auto look = [&](Weight& t) {
    t.y = Real(1) / (t.mass + t.w);
    t.slip = t.moved * t.y * t.y;
    t.speed = root(t.e + t.slip);
    t.share = t.slip * t.mass * t.y;
    t.slope = (t.e + t.share) / t.speed;
    t.excess = t.w * t.speed - t.bound;
};
auto start = [&]() {
    Weight t;
    t.e = Real(width * width);
    t.mass = MASS;
    t.bound = BOUND;
    t.moved = SQUARED * (MASS + BEFORE) * (MASS + BEFORE);
    Real half = Real(width / 2) * MASS;
    t.inner = root(t.moved + half * half);
    t.b = t.inner + Real(width) * MASS - BOUND;
    t.outer = root(t.b * t.b + Real(4 * width) * BOUND * MASS);
    t.w = t.first = Real(2) * BOUND * MASS / (t.b + t.outer);
    return t;
};
auto step = [&](Weight& t) {
    look(t);
    t.w -= t.excess / t.slope;
};
auto weight = [&]() {
    if (IDLE) return Real(0);
    Weight t = start();
    step(t);
    step(t);
    return t.w;
};
""".replace("IDLE", _IDLE)
)


@wp.func_native(
    *native(
        "weight()",
        f"if ({_IDLE}) return;"
        """
Weight t = start();
Real old[2];
for (int n = 0; n < 2; ++n) {
    old[n] = t.w;
    step(t);
}
Real adj_w = adj_RET, adj_moved = Real(0);
for (int n = 1; n >= 0; --n) {
    t.w = old[n];
    look(t);
    Real flat = Real(1) / t.slope, fast = Real(1) / t.speed;
    Real adj_excess = -adj_w * flat;
    Real adj_slope = -adj_excess * t.excess * flat;
    Real adj_share = adj_slope * fast;
    Real adj_speed = adj_excess * t.w - adj_share * t.slope;
    Real adj_slip = adj_share * MASS * t.y + Real(0.5) * adj_speed * fast;
    Real adj_y = adj_share * t.slip * MASS + Real(2) * adj_slip * t.moved * t.y;
    Real adj_inertia = -adj_y * t.y * t.y;
    adj_w += adj_excess * t.speed + adj_inertia;
    adj_BOUND -= adj_excess;
    adj_MASS += adj_share * t.slip * t.y + adj_inertia;
    adj_moved += adj_slip * t.y * t.y;
}
Real whole = Real(1) / (t.b + t.outer);
Real adj_whole = -adj_w * t.first * whole;
Real adj_under = adj_whole / (t.outer + t.outer);
Real adj_b = adj_whole + Real(2) * adj_under * t.b;
Real adj_inner = adj_b / (t.inner + t.inner);
adj_moved += adj_inner;
adj_BOUND += Real(2) * adj_w * MASS * whole + Real(4 * width) * adj_under * MASS;
adj_BOUND -= adj_b;
adj_MASS += Real(2) * adj_w * BOUND * whole + Real(4 * width) * adj_under * BOUND
    + Real(width) * adj_b + Real(width * width / 2) * adj_inner * MASS;
Real momentum = MASS + BEFORE;
adj_SQUARED += adj_moved * momentum * momentum;
Real adj_momentum = Real(2) * adj_moved * SQUARED * momentum;
adj_MASS += adj_momentum;
adj_BEFORE += adj_momentum;
""",
        _FRICTION,
    )
)
def friction_weight(
    mass: real, bound: real, applied: real, before: real, squared: real, width: scalar
) -> real:
    """Weight w = mu J / sqrt(slip^2 + width^2) at the slip that w itself leads to.

    A contact that moves like a point of ``mass`` and slipped by s with the weight
    ``before`` slips by s (mass + before) / (mass + w) with w. At w = ``before`` that is
    s: the mass changes how fast the solves converge, not what they converge to. More
    than a contact moves damps the change of weight, less lets it overshoot. Newton's
    method starts from below, where the law has slip + width in the place of the root.

    Args:
        mass: That of the robot: no less than what the contact moves [kg].
        bound: mu J, the largest friction impulse [N s].
        applied: J, the normal impulse, begins smoothly at 0 [N s].
        before: Weight in the solve before [kg].
        squared: Slip after that solve, squared [m^2/s^2].
        width: Velocity below which friction is viscous [m/s].
    """
    ...


_EXPONENTIAL = """
#if defined(__CUDA_ARCH__)
Real power = wp::exp(-A);
#else
Real power;
for (int i = 0; i < sizeof(Real) / sizeof(Number); ++i) power[i] = wp::exp(-A[i]);
#endif
"""


@wp.func_native(
    *native(
        "Real(1) / (Real(1) + power)",
        # RET (1 - RET) would lose all digits where RET is nearly 1
        """
Real small = A > Real(0) ? power : Real(1) / power;
Real whole = Real(1) + small;
adj_A += small / (whole * whole) * adj_RET;
""",
        _EXPONENTIAL,
    )
)
def logistic(a: real) -> real:
    """Smooth step from 0 to 1; its slope decays exponentially."""
    ...


@wp.func_native(
    *native(
        "half + half * A / (Real(1) + distance)",
        "adj_A += half / (distance * (Real(1) + distance)) * adj_RET;",
        ROOT
        + """
Real half = Real(0.5);
Real distance = root(Real(1) + A * A);
""",
    )
)
def algebraic(a: real) -> real:
    """Smooth step from 0 to 1, as steep at 0; its slope decays as 1/a^2."""
    ...


# sin(r) / r and cos(r) of x = r^2: by their series up to r = 1, which is accurate to
# 1e-16 there, and world by world beyond
_TRIGONOMETRY = """
struct Trigonometry {
    Real sinc, cosine;
    CUDA_CALLABLE Trigonometry(Real x) {
        sinc = cosine = Real(1);
        for (int n = 16; n > 0; n -= 2) {
            sinc = Real(1) - x * sinc * Real(Number(1) / (n * (n + 1)));
            cosine = Real(1) - x * cosine * Real(Number(1) / (n * (n - 1)));
        }
#if defined(__CUDA_ARCH__)
        if (x > Real(1)) set(x, sinc, cosine);
#else
        if (__builtin_reduce_max(x) > Number(1))
            for (int i = 0; i < sizeof(Real) / sizeof(Number); ++i)
                if (x[i] > Number(1)) {
                    Number s, c;
                    set(x[i], s, c);
                    sinc[i] = s;
                    cosine[i] = c;
                }
#endif
    }
    static CUDA_CALLABLE void set(Number x, Number& s, Number& c) {
        Number r = wp::sqrt(x);
        s = wp::sin(r) / r;
        c = wp::cos(r);
    }
};
"""


@wp.func_native(
    *native(
        "Quat(AXIS[0] * s, AXIS[1] * s, AXIS[2] * s, t.cosine)",
        """
Vec3 d(adj_RET.x, adj_RET.y, adj_RET.z);
adj_ANGLE += Real(0.5) * (t.cosine * wp::dot(AXIS, d) - s * adj_RET.w);
for (int i = 0; i < 3; ++i) adj_AXIS[i] += s * d[i];
""",
        _TRIGONOMETRY
        + """
Real half = Real(0.5) * ANGLE;
Trigonometry t(half * half);
Real s = half * t.sinc;
""",
    )
)
def turn_about(axis: vec3, angle: real) -> quat:
    """Rotation by an angle about a unit axis."""
    ...


@wp.func_native(
    *native(
        "Quat(A[0] * s, A[1] * s, A[2] * s, t.cosine)",
        """
// derivative of sinc with respect to x: (cos - sinc) / 2x, its series up to r = 1
Real slope = Real(1);
for (int n = 16; n > 2; n -= 2)
    slope = Real(1) - x * slope * Real(Number(n) / ((n - 2) * n * (n + 1)));
slope *= Real(Number(-1) / 6);
slope = x > Real(1) ? (t.cosine - t.sinc) / (x + x) : slope;
Vec3 d(adj_RET.x, adj_RET.y, adj_RET.z);
// d x / d A = A / 2
Real inward = Real(0.25) * (wp::dot(A, d) * slope - adj_RET.w * t.sinc);
for (int i = 0; i < 3; ++i) adj_A[i] += s * d[i] + inward * A[i];
""",
        _TRIGONOMETRY
        + """
Real x = Real(0.25) * wp::dot(A, A);
Trigonometry t(x);
Real s = Real(0.5) * t.sinc;
""",
    )
)
def turn_by(a: vec3) -> quat:
    """Exponential map: the rotation by the length of ``a`` about ``a``."""
    ...
