"""One linear solve: the articulated-body algorithm with contacts as added inertia.

Featherstone 2008, section 7.3, in velocity changes: every body's equation is
``inertia . change = wrench``, leaves hand what their joint cannot take on to their
parents, and changes come back from the root. All spatial quantities are about O in
world axes, so nothing is transformed on the way. This is L^T D L along the tree,
without ever forming the mass matrix; springs, damping and limits of a joint
(:mod:`.joints`) sit on its diagonal D.

An inertia is three blocks, ``ww``, ``wv`` and ``vv``: the angular impulse is
``ww w + wv v``, the linear one ``wv^T w + vv v``. A body's equation is stored nowhere:
what leaves it are the factors of its joint, which the adjoint (:mod:`.solve`) uses
again, and what it passes on.
"""

import warp as wp

from newton_qd.physics.kinds import JointKind

from . import mat33, pairs, plain, real, scalar, shared, sym33, sync, vec3
from .cpp.algebra import (
    add_diagonal,
    component,
    cross,
    dot,
    inverse,
    outer,
    parallel,
    skew,
    symmetric,
    translation,
    transpose,
    vector,
)
from .cpp.memory import load, store
from .cpp.operators import add, div, mul, sub  # noqa: F401
from .parameters import body_mass
from .structs import Model, Offsets, Scratch, root_factors

PAIRS = wp.constant(pairs)
SHARED = wp.constant(shared)
# Whether a limb hands its equation on in registers. A CPU has too few, and fast caches.
CARRIED = wp.constant(shared)


@plain
def own_equation(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Inertia and wrench of body ``i``: its own and its contacts'.

    Contacts of pairs are not among them: :mod:`.coupling` adds them. A contact at r
    with weight W = wt 1 + (wn - wt) n n^T is a point of mass wt there, and with
    R = [r]x and l = r x n adds (wn - wt) times l l^T, l n^T and n n^T. First mass
    moment, mass and bias wrench are apart; :func:`with_bias` adds them.

    Reads: m.contact_start, m.contact_stop, sc.parameter, sc.inertia, sc.moment,
        sc.point, sc.normal, sc.push, sc.weight_n, sc.weight_t.
    """
    body = offsets.body + i
    mass = body_mass(m, sc, offsets, i)
    moment = load(sc.moment, body)
    ww = load(sc.inertia, body)
    wv = mat33()
    vv = sym33()
    n = vec3()
    f = vec3()
    for c in range(load(m.contact_start, i), load(m.contact_stop, i)):
        r = load(sc.point, offsets.contact + c)
        normal = load(sc.normal, offsets.contact + c)
        wt = load(sc.weight_t, offsets.solve_contact + c)
        more = load(sc.weight_n, offsets.solve_contact + c) - wt
        p = load(sc.push, offsets.solve_contact + c)
        lever = cross(r, normal)
        moved = wt * r
        mass = mass + wt
        moment = moment + moved
        turned = more * lever
        ww = add_diagonal(
            ww + parallel(lever, turned) - parallel(r, moved), dot(r, moved)
        )
        wv = wv + outer(turned, normal)
        vv = vv + parallel(normal, more * normal)
        n = n + cross(r, p)
        f = f + p
    return ww, wv, vv, n, f, moment, mass


@plain
def with_bias(
    m: Model,
    sc: Scratch,
    offsets: Offsets,
    i: int,
    wv: mat33,
    vv: sym33,
    n: vec3,
    f: vec3,
    moment: vec3,
    mass: real,
):
    """Equation of body ``i`` with its mass, first mass moment and bias wrench.

    Reads: m.h, sc.wrench_w, sc.wrench_v.
    """
    n = n - m.h * load(sc.wrench_w, offsets.motion + i)
    f = f - m.h * load(sc.wrench_v, offsets.motion + i)
    return wv + skew(moment), add_diagonal(vv, mass), n, f


@plain
def eliminate_axis(
    m: Model,
    sc: Scratch,
    offsets: Offsets,
    i: int,
    ww: sym33,
    wv: mat33,
    vv: sym33,
    n: vec3,
    f: vec3,
):
    """Take the joint's dof out of body ``i``'s equation; returns what is passed on.

    Reads: m.v_start, sc.axis_w, sc.axis_v, sc.joint_push, sc.joint_weight.
    Writes: sc.lever_w, sc.lever_v, sc.share, sc.effort.
    """
    at = offsets.solve_body + i
    k = load(m.v_start, i)
    sw = load(sc.axis_w, offsets.dof + k)
    sv = load(sc.axis_v, offsets.dof + k)
    uw = ww * sw + wv * sv
    uv = sw * wv + vv * sv
    d = dot(sw, uw) + dot(sv, uv) + load(sc.joint_weight, offsets.solve_dof + k)
    share = scalar(1.0) / d
    effort = load(sc.joint_push, offsets.solve_dof + k) + dot(sw, n) + dot(sv, f)
    scaled_w = share * uw
    scaled_v = share * uv
    store(sc.lever_w, at, scaled_w)
    store(sc.lever_v, at, scaled_v)
    store(sc.share, at, share)
    store(sc.effort, offsets.reading + i, share * effort)
    return (
        ww - parallel(uw, scaled_w),
        wv - outer(uw, scaled_v),
        vv - parallel(uv, scaled_v),
        n - effort * scaled_w,
        f - effort * scaled_v,
    )


@plain
def eliminate_limb(m: Model, sc: Scratch, offsets: Offsets, limb: int):
    """Eliminate the joints of a limb, from tip to root.

    Reads: m.joint_kind, m.body_parent, m.limb_start, m.limb_body, m.child_start,
        m.child, sc.passed_ww, sc.passed_wv, sc.passed_vv, sc.passed_w, sc.passed_v.
    Writes: sc.passed_ww, sc.passed_wv, sc.passed_vv, sc.passed_w, sc.passed_v.
    """
    first = load(m.limb_start, limb)
    stop = load(m.limb_start, limb + 1)
    ww_in = sym33()
    wv_in = mat33()
    vv_in = sym33()
    n_in = vec3()
    f_in = vec3()
    for turn in range(stop - first):
        i = load(m.limb_body, stop - 1 - turn)
        ww, wv, vv, n, f, moment, mass = own_equation(m, sc, offsets, i)
        branch = load(m.child_start, i)
        branches = load(m.child_start, i + 1)
        if CARRIED:
            # only limbs that branch off the tip; inside of the limb there is one child
            if turn > 0:
                branches = branch
        for j in range(branch, branches):
            child = offsets.reading + load(m.child, j)
            ww = ww + load(sc.passed_ww, child)
            wv = wv + load(sc.passed_wv, child)
            vv = vv + load(sc.passed_vv, child)
            n = n + load(sc.passed_w, child)
            f = f + load(sc.passed_v, child)
        if CARRIED:
            ww = ww + ww_in
            wv = wv + wv_in
            vv = vv + vv_in
            n = n + n_in
            f = f + f_in
        wv, vv, n, f = with_bias(m, sc, offsets, i, wv, vv, n, f, moment, mass)
        if load(m.joint_kind, i) == JointKind.FREE:
            solve_free(m, sc, offsets, i, ww, wv, vv, n, f)
        else:
            ww, wv, vv, n, f = eliminate_axis(m, sc, offsets, i, ww, wv, vv, n, f)
            kept = load(m.body_parent, i)
            if CARRIED:
                ww_in = ww
                wv_in = wv
                vv_in = vv
                n_in = n
                f_in = f
                if turn < stop - first - 1:
                    kept = 0
            if kept > 0:
                here = offsets.reading + i
                store(sc.passed_ww, here, ww)
                store(sc.passed_wv, here, wv)
                store(sc.passed_vv, here, vv)
                store(sc.passed_w, here, n)
                store(sc.passed_v, here, f)


@plain
def rest_world(sc: Scratch, offsets: Offsets):
    """The world does not move.

    Writes: sc.change_w, sc.change_v.
    """
    store(sc.change_w, offsets.solve_body, vec3())
    store(sc.change_v, offsets.solve_body, vec3())


@plain
def change_axis(m: Model, sc: Scratch, offsets: Offsets, i: int, w: vec3, v: vec3):
    """Change of the joint's velocity and of body ``i``'s twist, which is returned.

    ``w`` and ``v`` are the change of the parent's twist.

    Reads: m.v_start, sc.axis_w, sc.axis_v, sc.lever_w, sc.lever_v, sc.effort.
    Writes: sc.dv, sc.change_w, sc.change_v.
    """
    at = offsets.solve_body + i
    k = load(m.v_start, i)
    dv = (
        load(sc.effort, offsets.reading + i)
        - dot(load(sc.lever_w, at), w)
        - dot(load(sc.lever_v, at), v)
    )
    w = w + dv * load(sc.axis_w, offsets.dof + k)
    v = v + dv * load(sc.axis_v, offsets.dof + k)
    store(sc.dv, offsets.solve_dof + k, dv)
    store(sc.change_w, at, w)
    store(sc.change_v, at, v)
    return w, v


@plain
def change_limb(m: Model, sc: Scratch, offsets: Offsets, limb: int):
    """Changes of the twists of a limb, from root to tip.

    Reads: m.joint_kind, m.body_parent, m.limb_start, m.limb_body, sc.change_w,
        sc.change_v.
    """
    first = load(m.limb_start, limb)
    root = load(m.limb_body, first)
    if load(m.joint_kind, root) == JointKind.FREE:
        first = first + 1
        up = offsets.solve_body + root
    else:
        up = offsets.solve_body + load(m.body_parent, root)
    w = load(sc.change_w, up)
    v = load(sc.change_v, up)
    for p in range(first, load(m.limb_start, limb + 1)):
        w, v = change_axis(m, sc, offsets, load(m.limb_body, p), w, v)


@plain
def solve_free(
    m: Model,
    sc: Scratch,
    offsets: Offsets,
    i: int,
    ww: sym33,
    wv: mat33,
    vv: sym33,
    n: vec3,
    f: vec3,
):
    """Solve a free root's own equation: 6 x 6, by blocks.

    With C = vv^-1 and Y = (ww - wv C wv^T)^-1, w = Y (n - wv C f) and
    v = C f - (wv C)^T w.

    Reads: m.v_start, sc.pose, sc.joint_push.
    Writes: sc.dv, sc.change_w, sc.change_v, sc.root_ww, sc.root_wv, sc.root_vv.
    """
    k = load(m.v_start, i)
    p = translation(load(sc.pose, offsets.body + i))
    push = offsets.solve_dof + k
    fj = vector(
        load(sc.joint_push, push),
        load(sc.joint_push, push + 1),
        load(sc.joint_push, push + 2),
    )
    nj = vector(
        load(sc.joint_push, push + 3),
        load(sc.joint_push, push + 4),
        load(sc.joint_push, push + 5),
    )
    n = n + nj + cross(p, fj)
    f = f + fj
    compliance = inverse(vv)
    reduced = wv * compliance
    turning = inverse(ww - symmetric(reduced * transpose(wv)))
    at = root_factors(m, offsets, i)
    store(sc.root_ww, at, turning)
    store(sc.root_wv, at, reduced)
    store(sc.root_vv, at, compliance)
    w = turning * (n - reduced * f)
    v = compliance * f - w * reduced
    store(sc.change_w, offsets.solve_body + i, w)
    store(sc.change_v, offsets.solve_body + i, v)
    # the joint's coordinates are the velocity of its origin and the angular velocity
    origin = v + cross(w, p)
    for j in range(3):
        store(sc.dv, offsets.solve_dof + k + j, component(origin, j))
        store(sc.dv, offsets.solve_dof + k + 3 + j, component(w, j))


@plain
def solve_tree(m: Model, sc: Scratch, offsets: Offsets, lane: int, lanes: int):
    """Eliminate joints, leaves to root; velocity changes, root to leaves.

    Reads: m.levels, m.roots, m.limb_level.
    """
    if lane == 0:
        rest_world(sc, offsets)
    # the lanes of roots read it
    if m.roots > 1:
        sync(lane)
    for turn in range(m.levels):
        level = m.levels - 1 - turn
        first = load(m.limb_level, level) + lane
        for limb in range(first, load(m.limb_level, level + 1), lanes):
            eliminate_limb(m, sc, offsets, limb)
        # the lanes of roots go on with them
        if level > 0:
            sync(lane)
    for level in range(m.levels):
        first = load(m.limb_level, level) + lane
        for limb in range(first, load(m.limb_level, level + 1), lanes):
            change_limb(m, sc, offsets, limb)
        sync(lane)


@plain
def contact_slip(m: Model, sc: Scratch, offsets: Offsets, c: int):
    """Change of a contact point's velocity by this solve; of a pair, relative.

    Reads: m.contact_body, m.contact_partner, sc.point, sc.change_w, sc.change_v.
    Writes: sc.slip.
    """
    at = offsets.solve_body + load(m.contact_body, c)
    r = load(sc.point, offsets.contact + c)
    dv = load(sc.change_v, at) + cross(load(sc.change_w, at), r)
    partner = int(-1)
    if PAIRS:
        partner = load(m.contact_partner, c)
    if partner >= 0:
        other = offsets.solve_body + load(m.contact_body, partner)
        dv = dv - (load(sc.change_v, other) + cross(load(sc.change_w, other), r))
    store(sc.slip, offsets.solve_contact + c, dv)
