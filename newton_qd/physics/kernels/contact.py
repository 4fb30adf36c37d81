"""Contacts of one robot sphere with one obstacle, linearised for the two solves.

The predictor solve takes the normal force as linear in the new velocity. Its normal
impulse may turn negative when a body lifts off, and its friction weight belongs to
the old velocity; so the corrector solve takes the predicted normal impulse, clipped
smoothly at zero, as given, and friction at the predicted slip. Normal impulses are
thus never negative and friction stays close to its cone.
"""

import warp as wp

from . import real, scalar, stage, vec3
from .algebra import (
    add,
    component,
    cross,
    div,
    dot,
    length,
    mul,
    neg,
    normalize,
    rotate,
    rotate_back,
    rotation,
    sub,
    transform_point,
    translation,
    vector,
)
from .memory import constant, load, store
from .numbers import clamp, sqrt, uniform
from .smooth import gate, penetration
from .structs import Model, Row, Scratch

# Hunt-Crossley factor and clipping switch over these fractions of their natural scale.
DISSIPATION_WIDTH = wp.constant(scalar(0.25))
CLIP_WIDTH = wp.constant(scalar(0.5))


@wp.func
def obstacle_normal(m: Model, o: int, at: vec3):
    """Outward unit normal at the obstacle point nearest to ``at`` (obstacle frame)."""
    n = vector(real(), real(), uniform(scalar(1.0)))
    if load(m.obstacle_kind, o) == 1:
        half = component(constant(m.obstacle_size, o), 1)
        nearest = vector(real(), real(), clamp(component(at, 2), neg(half), half))
        n = normalize(at - nearest)
    return n


@wp.func
def obstacle_distance(m: Model, o: int, at: vec3):
    """Signed distance of ``at`` (obstacle frame) from the obstacle's surface [m]."""
    d = component(at, 2)
    if load(m.obstacle_kind, o) == 1:
        half = component(constant(m.obstacle_size, o), 1)
        nearest = vector(real(), real(), clamp(component(at, 2), neg(half), half))
        d = length(at - nearest) - component(constant(m.obstacle_size, o), 0)
    return d


@stage
def contact_predictor(m: Model, sc: Scratch, row: Row, c: int):
    """Geometry, and the contact law linearised about the velocity at the start."""
    i = load(m.contact_body, c)
    o = load(m.contact_obstacle, c)
    x = load(sc.pose, row.body + i)
    center = transform_point(x, constant(m.contact_position, c))
    # the world's axes are never turned: only the origin is elsewhere
    frame = constant(m.obstacle_frame, o)
    turn = rotation(frame)
    world = translation(load(sc.pose, row.body))
    from_obstacle = center - world - translation(frame)
    at = rotate_back(turn, from_obstacle)
    normal = rotate(turn, obstacle_normal(m, o, at))
    radius = constant(m.contact_radius, c)
    gap = obstacle_distance(m, o, at) - radius
    r = center - radius * normal
    vc = load(sc.twist_v, row.body + i) + cross(load(sc.twist_w, row.body + i), r)
    vn = dot(normal, vc)
    vt = vc - vn * normal
    reach = gap + m.h * vn
    damper = penetration(m.dissipation * vn - scalar(1.0), uniform(DISSIPATION_WIDTH))
    k = (m.h * m.contact_stiffness) * damper
    width = uniform(m.contact_smoothing)
    push = k * penetration(reach, width)
    wt = m.friction * push / sqrt(m.slip_velocity * m.slip_velocity + dot(vt, vt))
    store(sc.point, row.contact + c, r)
    store(sc.arm, row.contact + c, r - transform_point(x, constant(m.com, i)))
    store(sc.normal, row.contact + c, normal)
    store(sc.velocity, row.contact + c, vc)
    store(sc.load, row.contact + c, push)
    store(sc.weight_n, row.solve_contact + c, m.h * k * gate(reach, width))
    store(sc.weight_t, row.solve_contact + c, wt)
    store(sc.push, row.solve_contact + c, push * normal - wt * vt)


@stage
def contact_slip(m: Model, sc: Scratch, row: Row, c: int):
    """Change of a contact point's velocity by the row's solve."""
    at = row.solve_body + load(m.contact_body, c)
    r = load(sc.point, row.contact + c)
    dv = load(sc.change_v, at) + cross(load(sc.change_w, at), r)
    store(sc.slip, row.solve_contact + c, dv)


@stage
def contact_corrector(m: Model, sc: Scratch, row: Row, c: int):
    """Clipped normal impulse, and friction at the predicted slip."""
    n = load(sc.normal, row.contact + c)
    vc = load(sc.velocity, row.contact + c)
    dv = load(sc.slip, row.predictor + c)
    push = load(sc.load, row.contact + c)
    linear = push - load(sc.weight_n, row.predictor + c) * dot(n, dv)
    normal_impulse = penetration(neg(linear), CLIP_WIDTH * push)
    v1 = vc + dv
    slip = v1 - dot(n, v1) * n
    wt = (
        m.friction
        * normal_impulse
        / sqrt(m.slip_velocity * m.slip_velocity + dot(slip, slip))
    )
    store(sc.normal_impulse, row.report + c, normal_impulse)
    store(sc.weight_n, row.solve_contact + c, real())
    store(sc.weight_t, row.solve_contact + c, wt)
    store(
        sc.push,
        row.solve_contact + c,
        normal_impulse * n - wt * (vc - dot(n, vc) * n),
    )


@stage
def contact_impulse(sc: Scratch, row: Row, c: int):
    """Impulse that the corrector applied, friction at the new velocity included."""
    n = load(sc.normal, row.contact + c)
    dv = load(sc.slip, row.solve_contact + c)
    j = load(sc.push, row.solve_contact + c) - load(
        sc.weight_t, row.solve_contact + c
    ) * (dv - dot(n, dv) * n)
    store(sc.impulse, row.report + c, j)
    store(sc.angular_impulse, row.report + c, cross(load(sc.arm, row.contact + c), j))
