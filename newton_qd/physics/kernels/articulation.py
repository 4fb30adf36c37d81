"""One linear solve: the articulated-body algorithm with contacts as added inertia.

Featherstone 2008, section 7.3, in velocity changes: every body's equation is
``inertia . change = wrench``, leaves hand what their joint cannot take on to their
parents, and changes come back from the root. All spatial quantities are about O in
world axes, so nothing is transformed on the way. This is L^T D L along the tree,
without ever forming the mass matrix; springs, damping and limits of a joint are
implicit in its new velocity and sit on its diagonal D.
"""

import warp as wp

from . import mat33, real, scalar, stage, vec3
from .cpp.algebra import (
    add_diagonal,
    component,
    cross,
    dot,
    inverse,
    outer,
    skew,
    translation,
    transpose,
    vector,
)
from .cpp.memory import constant, load, store
from .cpp.numbers import uniform
from .cpp.operators import add, div, mul, neg, sub  # noqa: F401
from .cpp.smooth import gate, penetration
from .parameters import body_mass, joint_damping
from .structs import Model, Offsets, Scratch

# Hunt-Crossley factors switch over this fraction of their natural scale.
DISSIPATION_WIDTH = wp.constant(scalar(0.25))


@wp.func
def point_weight(sc: Scratch, offsets: Offsets, c: int):
    """3 x 3 weight of a contact: impulse per change of the point's velocity [kg].

    Reads: sc.normal, sc.weight_n, sc.weight_t.
    """
    n = load(sc.normal, offsets.contact + c)
    wt = load(sc.weight_t, offsets.solve_contact + c)
    wn = load(sc.weight_n, offsets.solve_contact + c)
    return add_diagonal((wn - wt) * outer(n, n), wt)


@stage
def gather_children(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Inertia and wrench of body ``i``: its own, its contacts', its children's.

    Contacts of pairs are not among them: :mod:`.coupling` adds them.

    With R = [r]x a contact's weight W adds ww = R^T W R, wv = -(W R)^T, vv = W.

    Reads: m.h, m.child_start, m.child, m.contact_start, m.contact_stop,
        sc.parameter, sc.inertia, sc.moment, sc.wrench_w, sc.wrench_v, sc.point,
        sc.normal, sc.push, sc.weight_n, sc.weight_t, sc.passed_ww, sc.passed_wv,
        sc.passed_vv, sc.passed_w, sc.passed_v.
    Writes: sc.total_ww, sc.total_wv, sc.total_vv, sc.total_w, sc.total_v.
    """
    ww = mat33()
    wv = mat33()
    vv = mat33()
    n = vec3()
    f = vec3()
    for c in range(load(m.contact_start, i), load(m.contact_stop, i)):
        r = load(sc.point, offsets.contact + c)
        weight = point_weight(sc, offsets, c)
        lever = skew(r)
        turned = weight * lever
        p = load(sc.push, offsets.solve_contact + c)
        ww = ww - lever * turned
        wv = wv - transpose(turned)
        vv = vv + weight
        n = n + cross(r, p)
        f = f + p
    for j in range(load(m.child_start, i), load(m.child_start, i + 1)):
        child = offsets.solve_body + load(m.child, j)
        ww = ww + load(sc.passed_ww, child)
        wv = wv + load(sc.passed_wv, child)
        vv = vv + load(sc.passed_vv, child)
        n = n + load(sc.passed_w, child)
        f = f + load(sc.passed_v, child)
    at = offsets.solve_body + i
    body = offsets.body + i
    store(sc.total_ww, at, ww + load(sc.inertia, body))
    store(sc.total_wv, at, wv + skew(load(sc.moment, body)))
    store(sc.total_vv, at, add_diagonal(vv, body_mass(m, sc, offsets, i)))
    store(sc.total_w, at, n - m.h * load(sc.wrench_w, offsets.motion + i))
    store(sc.total_v, at, f - m.h * load(sc.wrench_v, offsets.motion + i))


@stage
def eliminate_axis(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Take the joint's dof out of body ``i``'s equation; pass the rest on.

    Reads: m.h, m.q_start, m.v_start, m.dof_control, m.gear, m.armature,
        m.stiffness, m.spring_rest, m.limit_lower, m.limit_upper, m.limit_stiffness,
        m.limit_smoothing, m.limit_dissipation, sc.q, sc.v, sc.ctrl, sc.parameter,
        sc.axis_w, sc.axis_v, sc.total_ww, sc.total_wv, sc.total_vv, sc.total_w,
        sc.total_v, sc.dv.
    Writes: sc.passed_ww, sc.passed_wv, sc.passed_vv, sc.passed_w, sc.passed_v,
        sc.lever_w, sc.lever_v, sc.effort, sc.share.
    """
    at = offsets.solve_body + i
    k = load(m.v_start, i)
    h = m.h
    qk = load(sc.q, offsets.q + load(m.q_start, i))
    vk = load(sc.v, offsets.v + k)
    # limits are linearised about the velocity that the solve before found
    change = real()
    if offsets.corrects > 0:
        change = load(sc.dv, offsets.before_dof + k)
    rate = vk + change
    ahead = qk + h * rate
    ks = constant(m.stiffness, k)
    kl = constant(m.limit_stiffness, k)
    kd = joint_damping(m, sc, offsets, k)
    width = uniform(m.limit_smoothing)
    lower = ahead - constant(m.limit_lower, k)
    upper = constant(m.limit_upper, k) - ahead
    # Hunt and Crossley's factor: a limit gives back less than it takes
    away = m.limit_dissipation * rate
    inward = neg(away) - scalar(1.0)
    away = away - scalar(1.0)
    brake = uniform(DISSIPATION_WIDTH)
    depth_lower = kl * penetration(lower, width)
    depth_upper = kl * penetration(upper, width)
    damper_lower = penetration(away, brake)
    damper_upper = penetration(inward, brake)
    weight = h * kl * (
        damper_lower * gate(lower, width) + damper_upper * gate(upper, width)
    ) + m.limit_dissipation * (
        depth_lower * gate(away, brake) + depth_upper * gate(inward, brake)
    )
    force = (
        depth_lower * damper_lower
        - depth_upper * damper_upper
        + weight * change
        - ks * (qk + h * vk - constant(m.spring_rest, k))
        - kd * vk
    )
    implicit = h * (weight + kd + h * ks)
    u = load(m.dof_control, k)
    if u >= 0:
        force = force + constant(m.gear, k) * load(sc.ctrl, offsets.ctrl + u)

    sw = load(sc.axis_w, offsets.dof + k)
    sv = load(sc.axis_v, offsets.dof + k)
    ww = load(sc.total_ww, at)
    wv = load(sc.total_wv, at)
    vv = load(sc.total_vv, at)
    n = load(sc.total_w, at)
    f = load(sc.total_v, at)
    uw = ww * sw + wv * sv
    uv = sw * wv + vv * sv
    d = dot(sw, uw) + dot(sv, uv) + constant(m.armature, k) + implicit
    share = scalar(1.0) / d
    effort = h * force + dot(sw, n) + dot(sv, f)
    scaled_w = share * uw
    scaled_v = share * uv
    store(sc.passed_ww, at, ww - outer(uw, scaled_w))
    store(sc.passed_wv, at, wv - outer(uw, scaled_v))
    store(sc.passed_vv, at, vv - outer(uv, scaled_v))
    store(sc.passed_w, at, n - effort * scaled_w)
    store(sc.passed_v, at, f - effort * scaled_v)
    store(sc.lever_w, at, scaled_w)
    store(sc.lever_v, at, scaled_v)
    store(sc.effort, at, share * effort)
    store(sc.share, at, share)


@stage
def rest_world(sc: Scratch, offsets: Offsets):
    """The world does not move.

    Writes: sc.change_w, sc.change_v.
    """
    store(sc.change_w, offsets.tree, vec3())
    store(sc.change_v, offsets.tree, vec3())


@stage
def change_axis(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Change of the joint's velocity and of body ``i``'s twist.

    Reads: m.body_parent, m.v_start, sc.axis_w, sc.axis_v, sc.lever_w, sc.lever_v,
        sc.effort, sc.change_w, sc.change_v.
    Writes: sc.change_w, sc.change_v, sc.dv.
    """
    at = offsets.solve_body + i
    up = offsets.tree + load(m.body_parent, i)
    to = offsets.tree + i
    k = load(m.v_start, i)
    w = load(sc.change_w, up)
    v = load(sc.change_v, up)
    dv = (
        load(sc.effort, at)
        - dot(load(sc.lever_w, at), w)
        - dot(load(sc.lever_v, at), v)
    )
    store(sc.dv, offsets.tree_dof + k, dv)
    store(sc.change_w, to, w + dv * load(sc.axis_w, offsets.dof + k))
    store(sc.change_v, to, v + dv * load(sc.axis_v, offsets.dof + k))


@stage
def change_free(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Solve a free root's own equation: 6 x 6, by blocks.

    Reads: m.h, m.v_start, sc.ctrl, sc.pose, sc.total_ww, sc.total_wv, sc.total_vv,
        sc.total_w, sc.total_v.
    Writes: sc.change_w, sc.change_v, sc.dv.
    """
    at = offsets.solve_body + i
    k = load(m.v_start, i)
    p = translation(load(sc.pose, offsets.body + i))
    fj = m.h * vector(
        free_force(m, sc, offsets, k),
        free_force(m, sc, offsets, k + 1),
        free_force(m, sc, offsets, k + 2),
    )
    nj = m.h * vector(
        free_force(m, sc, offsets, k + 3),
        free_force(m, sc, offsets, k + 4),
        free_force(m, sc, offsets, k + 5),
    )
    wv = load(sc.total_wv, at)
    n = load(sc.total_w, at) + nj + cross(p, fj)
    f = load(sc.total_v, at) + fj
    compliance = inverse(load(sc.total_vv, at))
    reduced = wv * compliance
    w = inverse(load(sc.total_ww, at) - reduced * transpose(wv)) * (n - reduced * f)
    v = compliance * (f - w * wv)
    store(sc.change_w, offsets.tree + i, w)
    store(sc.change_v, offsets.tree + i, v)
    # the joint's coordinates are the velocity of its origin and the angular velocity
    origin = v + cross(w, p)
    for j in range(3):
        store(sc.dv, offsets.tree_dof + k + j, component(origin, j))
        store(sc.dv, offsets.tree_dof + k + 3 + j, component(w, j))


@wp.func
def free_force(m: Model, sc: Scratch, offsets: Offsets, k: int):
    """Force on dof ``k`` of a free joint [N or N m]; none unless it is driven.

    Reads: m.dof_control, m.gear, sc.ctrl.
    """
    force = real()
    u = load(m.dof_control, k)
    if u >= 0:
        force = constant(m.gear, k) * load(sc.ctrl, offsets.ctrl + u)
    return force
