"""Nearest points of a robot's sphere or capsule and one static obstacle.

All in the frame of the obstacle. The nearest points of two segments jump to the other
ends when the segments turn past parallel, and bend where they reach an end. Here they
minimise |distance|^2 + k (share of the segment)^2 with the ends rounded off, which is
twice differentiable in everything. So the distance comes out too large, by at most 0.3
of the contact smoothing where the surfaces touch: when the segments are parallel to a
few degrees, or cross near an end. The obstacle is a plane, a capsule or a box.
"""

import warp as wp

from newton_qd.physics.kinds import ObstacleKind

from . import boxes, real, scalar, vec3
from .box import box_distance, box_normal, box_share
from .cpp.algebra import (
    component,
    dot,
    rotate,
    rotate_back,
    rotation,
    transform_point,
    translation,
    vector,
)
from .cpp.memory import constant, load
from .cpp.numbers import uniform
from .cpp.operators import add, div, mul, neg, sub  # noqa: F401
from .cpp.smooth import bounded, finite_length
from .structs import Model, Offsets, Scratch

BOXES = wp.constant(boxes)
# A share of a segment is rounded off over this distance from its ends, -1 and 1.
SHARE_ROUNDING = wp.constant(scalar(0.1))


@wp.func
def segment_share(
    m: Model,
    reach: real,
    at: vec3,
    along: vec3,
    height: real,
    slope: real,
    half: real,
):
    """Where on a segment it is nearest to another one, -1 to 1.

    Minimises |at + s along - t axis|^2 + k s^2 over |s| <= 1 and |t| <= half: s for an
    endless axis, then t at that s, then s at that t.

    Reads: m.contact_smoothing.

    Args:
        m: The model.
        reach: Distance of the two where their surfaces touch [m].
        at: Centre of the segment, from the centre of the other one.
        along: From the centre to an end; zero for a sphere, which gives 0.
        height: Component of ``at`` along the axis of the other one [m].
        slope: Component of ``along`` [m].
        half: Half length of the other one [m].
    """
    rounding = uniform(SHARE_ROUNDING)
    one = uniform(scalar(1.0))
    k = m.contact_smoothing * reach
    whole = dot(along, along) + k
    across = dot(at, along) - height * slope
    free = bounded(neg(across / (whole - slope * slope)), one, rounding)
    t = bounded(height + free * slope, half, uniform(m.contact_smoothing))
    return bounded(neg((dot(at, along) - t * slope) / whole), one, rounding)


@wp.func
def nearest_share(m: Model, c: int, o: int, at: vec3, along: vec3):
    """Where on its segment contact ``c`` is nearest to capsule or box ``o``, -1 to 1.

    Reads: m.contact_radius, m.obstacle_kind, m.obstacle_size.

    Args:
        m: The model.
        c: The contact.
        o: The obstacle.
        at: Centre of the robot's segment.
        along: From the centre to an end; zero for a sphere, which gives 0.
    """
    size = constant(m.obstacle_size, o)
    radius = constant(m.contact_radius, c)
    share = real()
    if load(m.obstacle_kind, o) == ObstacleKind.CAPSULE:
        share = segment_share(
            m,
            radius + component(size, 0),
            at,
            along,
            component(at, 2),
            component(along, 2),
            component(size, 1),
        )
    if BOXES:
        if load(m.obstacle_kind, o) == ObstacleKind.BOX:
            free = box_share(m, size, radius, at, along)
            share = bounded(free, uniform(scalar(1.0)), uniform(SHARE_ROUNDING))
    return share


@wp.func
def from_axis(m: Model, o: int, at: vec3):
    """Vector from the nearest point of a capsule's axis.

    Reads: m.obstacle_size, m.contact_smoothing.
    """
    half = component(constant(m.obstacle_size, o), 1)
    t = bounded(component(at, 2), half, uniform(m.contact_smoothing))
    return at - vector(real(), real(), t)


@wp.func
def obstacle_normal(m: Model, o: int, at: vec3):
    """Outward normal at the obstacle point nearest to ``at``.

    Reads: m.obstacle_kind, m.obstacle_size.
    """
    n = vector(real(), real(), uniform(scalar(1.0)))
    if load(m.obstacle_kind, o) == ObstacleKind.CAPSULE:
        away = from_axis(m, o, at)
        n = (scalar(1.0) / finite_length(away)) * away
    if BOXES:
        if load(m.obstacle_kind, o) == ObstacleKind.BOX:
            n = box_normal(m, constant(m.obstacle_size, o), at)
    return n


@wp.func
def obstacle_distance(m: Model, o: int, at: vec3):
    """Signed distance of ``at`` from the obstacle's surface [m].

    Reads: m.obstacle_kind, m.obstacle_size.
    """
    d = component(at, 2)
    if load(m.obstacle_kind, o) == ObstacleKind.CAPSULE:
        radius = component(constant(m.obstacle_size, o), 0)
        d = finite_length(from_axis(m, o, at)) - radius
    if BOXES:
        if load(m.obstacle_kind, o) == ObstacleKind.BOX:
            d = box_distance(m, constant(m.obstacle_size, o), at)
    return d


@wp.func
def touch_obstacle(m: Model, sc: Scratch, offsets: Offsets, c: int):
    """Contact point and outward normal in world axes, and gap, at an obstacle.

    Reads: m.contact_body, m.contact_position, m.contact_segment, m.contact_radius,
        m.contact_obstacle, m.obstacle_kind, m.obstacle_frame, sc.pose.
    """
    o = load(m.contact_obstacle, c)
    x = load(sc.pose, offsets.body + load(m.contact_body, c))
    center = transform_point(x, constant(m.contact_position, c))
    # the world's axes are never turned: only the origin is elsewhere
    frame = constant(m.obstacle_frame, o)
    turn = rotation(frame)
    world = translation(load(sc.pose, offsets.body))
    at = rotate_back(turn, center - world - translation(frame))
    if load(m.obstacle_kind, o) != ObstacleKind.PLANE:
        half = rotate(rotation(x), constant(m.contact_segment, c))
        along = rotate_back(turn, half)
        share = nearest_share(m, c, o, at, along)
        center = center + share * half
        at = at + share * along
    radius = constant(m.contact_radius, c)
    gap = obstacle_distance(m, o, at) - radius
    normal = rotate(turn, obstacle_normal(m, o, at))
    return center - radius * normal, normal, gap
