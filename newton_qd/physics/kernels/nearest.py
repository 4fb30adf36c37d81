"""Nearest points of a robot's sphere or capsule and one static obstacle.

All in the frame of the obstacle. The nearest points of two segments jump to the other
ends when the segments turn past parallel, and bend where they reach an end. Here they
minimise |distance|^2 + k (share of the segment)^2 with the ends rounded off, which is
twice differentiable in everything. So the distance comes out too large, by at most 0.3
of the contact smoothing where the surfaces touch: when the segments are parallel to a
few degrees, or cross near an end.
"""

import warp as wp

from . import real, scalar, vec3
from .algebra import add, component, div, dot, mul, neg, sub, vector
from .memory import constant, load
from .numbers import sqrt, uniform
from .smooth import penetration
from .structs import Model

# A share of a segment is rounded off over this distance from its ends, -1 and 1.
SHARE_ROUNDING = wp.constant(scalar(0.1))
# Distances are of vectors no shorter than this [m]: a direction is always finite.
SHORTEST = wp.constant(scalar(1.0e-5))


@wp.func
def bounded(a: real, bound: real, rounding: real):
    """Smooth clamp of ``a`` between ``-bound`` and ``bound``."""
    return a - penetration(bound - a, rounding) + penetration(bound + a, rounding)


@wp.func
def nearest_share(m: Model, c: int, o: int, at: vec3, along: vec3):
    """Where on its segment contact ``c`` is nearest to capsule ``o``, -1 to 1.

    Minimises |at + s along - t z|^2 + k s^2 over |s| <= 1 and t on the axis of the
    capsule: s for an endless axis, then t at that s, then s at that t.

    Args:
        m: The model.
        c: The contact.
        o: The obstacle.
        at: Centre of the robot's segment.
        along: From the centre to an end; zero for a sphere, which gives 0.
    """
    rounding = uniform(SHARE_ROUNDING)
    one = uniform(scalar(1.0))
    size = constant(m.obstacle_size, o)
    reach = constant(m.contact_radius, c) + component(size, 0)
    k = m.contact_smoothing * reach
    slope = component(along, 2)
    height = component(at, 2)
    whole = dot(along, along) + k
    across = dot(at, along) - height * slope
    free = bounded(neg(across / (whole - slope * slope)), one, rounding)
    t = bounded(height + free * slope, component(size, 1), uniform(m.contact_smoothing))
    return bounded(neg((dot(at, along) - t * slope) / whole), one, rounding)


@wp.func
def from_axis(m: Model, o: int, at: vec3):
    """Vector from the nearest point of a capsule's axis."""
    half = component(constant(m.obstacle_size, o), 1)
    t = bounded(component(at, 2), half, uniform(m.contact_smoothing))
    return at - vector(real(), real(), t)


@wp.func
def finite_length(a: vec3):
    """Length of a vector; never less than ``SHORTEST``."""
    return sqrt(SHORTEST * SHORTEST + dot(a, a))


@wp.func
def obstacle_normal(m: Model, o: int, at: vec3):
    """Outward normal at the obstacle point nearest to ``at``."""
    n = vector(real(), real(), uniform(scalar(1.0)))
    if load(m.obstacle_kind, o) == 1:
        away = from_axis(m, o, at)
        n = (scalar(1.0) / finite_length(away)) * away
    return n


@wp.func
def obstacle_distance(m: Model, o: int, at: vec3):
    """Signed distance of ``at`` from the obstacle's surface [m]."""
    d = component(at, 2)
    if load(m.obstacle_kind, o) == 1:
        radius = component(constant(m.obstacle_size, o), 0)
        d = finite_length(from_axis(m, o, at)) - radius
    return d
