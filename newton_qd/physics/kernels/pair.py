"""Contact point of a pair: spheres or capsules of two bodies that both move.

Each side of a pair has a row of its own. Both rows measure the pair from the same
side, its lead, so they find the same point and the same gap, and normals that are equal
and opposite to the last digit.
"""

import warp as wp

from . import scalar
from .cpp.algebra import dot, rotate, rotation, transform_point
from .cpp.memory import constant, load
from .cpp.numbers import uniform
from .cpp.operators import add, div, mul, neg, sub  # noqa: F401
from .cpp.smooth import bounded, finite_length
from .nearest import segment_share
from .structs import Model, Offsets, Scratch


@wp.func
def touch_partner(m: Model, sc: Scratch, offsets: Offsets, c: int):
    """Contact point and normal towards row ``c`` in world axes, and gap, of a pair.

    Reads: m.contact_body, m.contact_position, m.contact_segment, m.contact_radius,
        m.contact_partner, m.contact_lead, m.contact_smoothing, sc.pose.
    """
    a = load(m.contact_lead, c)
    b = load(m.contact_partner, a)
    pose_a = load(sc.pose, offsets.body + load(m.contact_body, a))
    pose_b = load(sc.pose, offsets.body + load(m.contact_body, b))
    center = transform_point(pose_a, constant(m.contact_position, a))
    along = rotate(rotation(pose_a), constant(m.contact_segment, a))
    other = rotate(rotation(pose_b), constant(m.contact_segment, b))
    half = finite_length(other)
    axis = (scalar(1.0) / half) * other
    at = center - transform_point(pose_b, constant(m.contact_position, b))
    radius = constant(m.contact_radius, a)
    reach = radius + constant(m.contact_radius, b)
    slope = dot(along, axis)
    share = segment_share(m, reach, at, along, dot(at, axis), slope, half)
    at = at + share * along
    away = at - bounded(dot(at, axis), half, uniform(m.contact_smoothing)) * axis
    distance = finite_length(away)
    normal = (scalar(1.0) / distance) * away
    gap = distance - reach
    # in the middle between the two surfaces
    point = center + share * along - (radius + scalar(0.5) * gap) * normal
    if a != c:
        normal = neg(normal)
    return point, normal, gap
