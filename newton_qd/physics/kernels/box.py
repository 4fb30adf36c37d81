"""Nearest points of a segment and a box, in the frame of the box.

Outside, the distance is that from the point clamped to the box; inside, it is the
depth below the nearest face. Clamps and the choice of a face are rounded off over the
contact smoothing w, so that both are twice differentiable: edges are round, by 0.4 w
at most, and the middle of the box, where no face is the nearest, is as smooth.
"""

import warp as wp

from . import real, scalar, vec3
from .cpp.algebra import component, dot, vector
from .cpp.numbers import above, choose, clamp, occurs, uniform
from .cpp.operators import add, div, mul, neg, sub  # noqa: F401
from .cpp.smooth import finite_length, gate, penetration
from .structs import Model

# Where the nearest point of a segment is searched: beyond both ends, -1 and 1.
SEARCHED = wp.constant(scalar(1.25))
# Halvings of that range, too many for Warp to unroll, and steps of Newton's method.
HALVINGS = wp.constant(17)
NEWTON_STEPS = wp.constant(2)
# Times this, all numbers but the smallest are beyond 1.
SIGN = wp.constant(scalar(1.0e20))
# No wall holds what is faster [m/s]: what does not reach a box at this speed within a
# substep is not searched on.
FASTEST = wp.constant(scalar(100.0))


@wp.func
def beyond_faces(at: vec3, half: vec3, width: real):
    """Vector from the nearest point of the box; zero inside."""
    up = half - at
    down = half + at
    return vector(
        penetration(component(up, 0), width) - penetration(component(down, 0), width),
        penetration(component(up, 1), width) - penetration(component(down, 1), width),
        penetration(component(up, 2), width) - penetration(component(down, 2), width),
    )


@wp.func
def beyond_slopes(at: vec3, half: vec3, width: real):
    """Slope of each component of ``beyond_faces``, 0 inside and 1 outside."""
    up = half - at
    down = half + at
    return vector(
        gate(component(up, 0), width) + gate(component(down, 0), width),
        gate(component(up, 1), width) + gate(component(down, 1), width),
        gate(component(up, 2), width) + gate(component(down, 2), width),
    )


@wp.func
def over_face(at: vec3, half: vec3, j: int, width: real):
    """Height over the nearer one of the two faces across axis ``j``; smooth."""
    a = component(at, j)
    return penetration(a, width) + penetration(neg(a), width) - component(half, j)


@wp.func
def outward(at: vec3, j: int, width: real):
    """Slope of ``over_face``, from -1 to 1."""
    a = component(at, j)
    return gate(neg(a), width) - gate(a, width)


@wp.func
def box_distance(m: Model, half: vec3, at: vec3):
    """Signed distance of ``at`` from the surface of a box [m].

    Reads: m.contact_smoothing.
    """
    w = uniform(m.contact_smoothing)
    x = over_face(at, half, 0, w)
    y = over_face(at, half, 1, w)
    z = over_face(at, half, 2, w)
    # the largest of the three, two at a time: max(a, b) = a + max(b - a, 0)
    xy = x + penetration(x - y, w)
    top = xy + penetration(xy - z, w)
    return finite_length(beyond_faces(at, half, w)) - penetration(top, w)


@wp.func
def box_normal(m: Model, half: vec3, at: vec3):
    """Direction in which ``box_distance`` grows.

    Reads: m.contact_smoothing.
    """
    w = uniform(m.contact_smoothing)
    x = over_face(at, half, 0, w)
    y = over_face(at, half, 1, w)
    z = over_face(at, half, 2, w)
    xy = x + penetration(x - y, w)
    to_y = gate(x - y, w)
    to_z = gate(xy - z, w)
    top = xy + penetration(xy - z, w)
    inside = gate(top, w)
    away = beyond_faces(at, half, w)
    slopes = beyond_slopes(at, half, w)
    d = scalar(1.0) / finite_length(away)
    not_z = inside * (scalar(1.0) - to_z)
    n = vector(
        d * component(away, 0) * component(slopes, 0)
        + not_z * (scalar(1.0) - to_y) * outward(at, 0, w),
        d * component(away, 1) * component(slopes, 1)
        + not_z * to_y * outward(at, 1, w),
        d * component(away, 2) * component(slopes, 2)
        + inside * to_z * outward(at, 2, w),
    )
    return (scalar(1.0) / finite_length(n)) * n


@wp.func
def pull(half: vec3, width: real, k: real, at: vec3, along: vec3, s: real):
    """Slope of |distance|^2 / 2 + k s^2 / 2 along a segment, at share ``s``."""
    return dot(along, beyond_faces(at + s * along, half, width)) + k * s


@wp.func
def searched_share(
    half: vec3, width: real, k: real, at: vec3, along: vec3, reach: real
):
    """Where ``pull`` changes its sign, by bisection; without adjoint.

    0 for a sphere, and where nothing of the segment is within ``reach`` of the box. If
    that holds in all worlds of the pack, nothing is searched.
    """
    s = real()
    step = scalar(SEARCHED)
    one = uniform(scalar(1.0))
    length = finite_length(along)
    away = finite_length(beyond_faces(at, half, width))
    near = above(reach + length - away, scalar(0.0))
    near = near * above(dot(along, along), scalar(0.0))
    for _ in range(HALVINGS * occurs(near)):
        step = scalar(0.5) * step
        sign = clamp(SIGN * pull(half, width, k, at, along, s), neg(one), one)
        s = s - step * sign
    return choose(near, s, real())


@wp.func_grad(searched_share)
def adj_searched_share(
    half: vec3,
    width: real,
    k: real,
    at: vec3,
    along: vec3,
    reach: real,
    adj_ret: real,
):
    """Nothing: the steps that follow carry the derivative."""


@wp.func
def box_share(m: Model, half: vec3, radius: real, at: vec3, along: vec3):
    """Where a segment is nearest to a box: -1 to 1, and beyond if its end is.

    Minimises |distance|^2 + k s^2, with k = smoothing * radius. ``pull`` grows with s,
    so its zero is unique; Newton's method from the place found gives its value and its
    derivative.

    Reads: m.contact_smoothing, m.h.

    Args:
        m: The model.
        half: Half extents of the box [m].
        radius: Of the segment [m].
        at: Centre of the segment.
        along: From the centre to an end; zero for a sphere, which gives 0.
    """
    w = uniform(m.contact_smoothing)
    k = m.contact_smoothing * radius
    reach = radius + uniform(m.contact_smoothing + FASTEST * m.h)
    s = searched_share(half, w, k, at, along, reach)
    for _ in range(NEWTON_STEPS):
        slopes = beyond_slopes(at + s * along, half, w)
        growth = (
            component(slopes, 0) * component(along, 0) * component(along, 0)
            + component(slopes, 1) * component(along, 1) * component(along, 1)
            + component(slopes, 2) * component(along, 2) * component(along, 2)
            + k
        )
        s = s - pull(half, w, k, at, along, s) / growth
    return s
