"""What each quantity takes of the adjoint of a linear solve; see :mod:`.solve`.

An adjoint is added to where one lane owns the entry, so without atomics. Those of what
the solve found are 0 in the end, as before.
"""

import warp as wp

from newton_qd.physics.kinds import JointKind

from . import parametric, plain, quat, real, scalar, vec3, width
from .answers import pair_side
from .articulation import SHARED
from .coupling import PAIRS
from .cpp.algebra import component, cross, dot, form_slope, rigid, translation, vector
from .cpp.memory import add_adjoint, load, load_adjoint, store, store_adjoint
from .cpp.numbers import occurs
from .cpp.operators import add, mul, neg, sub  # noqa: F401
from .parameters import PARAMETRIC, body_mass
from .structs import Model, Offsets, Scratch

# A CPU skips contacts that act on no world of a pack: the law begins smoothly, so they
# have no slope, unless the stiffness is a parameter and 0.
IDLES = wp.constant(width > 1 and not parametric)


@plain
def contact_acts(sc: Scratch, offsets: Offsets, c: int):
    """Above 0 if a contact acts on some world of the pack, or may have a slope.

    Reads: sc.push_n, sc.weight_n, sc.weight_t.
    """
    count = int(1)
    if IDLES:
        at = offsets.solve_contact + c
        count = (
            occurs(load(sc.push_n, at))
            + occurs(load(sc.weight_n, at))
            + occurs(load(sc.weight_t, at))
        )
    return count


@plain
def contact_part(
    sc: Scratch, offsets: Offsets, c: int, xw: vec3, xv: vec3, lw: vec3, lv: vec3
):
    """Parts of contact ``c``; returns its impulse, and that of the adjoint.

    The adjoint's is the adjoint of the slip, less the weight times the multiplier.

    Reads: sc.point, sc.normal, sc.push, sc.weight_n, sc.weight_t, g.slip.
    Writes: g.point, g.normal, g.push, g.weight_n, g.weight_t, g.slip.

    Args:
        sc: The scratch.
        offsets: Offsets of the solve.
        c: The contact.
        xw: Change of angular velocity of its body, of a pair relative.
        xv: Change of velocity, likewise.
        lw: Multiplier of the angular velocity, likewise.
        lv: Multiplier of the velocity, likewise.
    """
    at = offsets.solve_contact + c
    r = load(sc.point, offsets.contact + c)
    impulse = vec3()
    back = load_adjoint(sc.slip, at)
    store_adjoint(sc.slip, at, vec3())
    if contact_acts(sc, offsets, c) > 0:
        n = load(sc.normal, offsets.contact + c)
        wt = load(sc.weight_t, at)
        more = load(sc.weight_n, at) - wt
        moved = xv + cross(xw, r)
        multiplier = lv + cross(lw, r)
        un = dot(n, moved)
        ln = dot(n, multiplier)
        both = un * ln
        impulse = load(sc.push, at) - wt * moved - (more * un) * n
        back = back - wt * multiplier - (more * ln) * n
        add_adjoint(sc.push, at, multiplier)
        add_adjoint(sc.weight_n, at, neg(both))
        add_adjoint(sc.weight_t, at, both - dot(multiplier, moved))
        turned = (more * ln) * moved + (more * un) * multiplier
        add_adjoint(sc.normal, offsets.contact + c, neg(turned))
    add_adjoint(sc.point, offsets.contact + c, cross(impulse, lw) + cross(back, xw))
    return impulse, back


@plain
def pair_part(m: Model, sc: Scratch, offsets: Offsets, j: int):
    """Parts of pair ``j``; keeps its impulse, and its weight times multiplier.

    Reads: m.contact_body, m.contact_partner, m.pair_lead, sc.point, sc.change_w,
        sc.change_v, sc.pair_w, sc.pair_v, sc.multiplier_w, sc.multiplier_v.
    Writes: sc.pair_impulse, sc.pair_w, sc.pair_v.
    """
    c = load(m.pair_lead, j)
    a = load(m.contact_body, c)
    b = load(m.contact_body, load(m.contact_partner, c))
    x = offsets.solve_body
    at = offsets.reading
    impulse, back = contact_part(
        sc,
        offsets,
        c,
        load(sc.change_w, x + a) - load(sc.change_w, x + b),
        load(sc.change_v, x + a) - load(sc.change_v, x + b),
        load(sc.multiplier_w, at + a) - load(sc.multiplier_w, at + b),
        load(sc.multiplier_v, at + a) - load(sc.multiplier_v, at + b),
    )
    store(sc.pair_impulse, offsets.pair + j, impulse)
    turned = cross(load(sc.point, offsets.contact + c), back)
    pair = offsets.pair + j
    store(sc.pair_w, pair, load(sc.pair_w, pair) + turned)
    store(sc.pair_v, pair, load(sc.pair_v, pair) + back)


@plain
def rigid_part(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Parts of body ``i``'s inertia and wrench; returns its residual wrenches.

    Reads: m.h, m.parameters, sc.parameter, sc.inertia, sc.moment, sc.wrench_w,
        sc.wrench_v, sc.change_w, sc.change_v, sc.multiplier_w, sc.multiplier_v.
    Writes: g.parameter, g.inertia, g.moment, g.wrench_w, g.wrench_v.
    """
    body = offsets.body + i
    motion = offsets.motion + i
    xw = load(sc.change_w, offsets.solve_body + i)
    xv = load(sc.change_v, offsets.solve_body + i)
    lw = load(sc.multiplier_w, offsets.reading + i)
    lv = load(sc.multiplier_v, offsets.reading + i)
    io = load(sc.inertia, body)
    hm = load(sc.moment, body)
    mass = body_mass(m, sc, offsets, i)
    rw = neg(m.h * load(sc.wrench_w, motion) + io * xw + cross(hm, xv))
    rv = cross(hm, xw) - mass * xv - m.h * load(sc.wrench_v, motion)
    qw = neg(io * lw + cross(hm, lv))
    qv = cross(hm, lw) - mass * lv
    add_adjoint(sc.wrench_w, motion, neg(m.h * lw))
    add_adjoint(sc.wrench_v, motion, neg(m.h * lv))
    add_adjoint(sc.inertia, body, neg(form_slope(lw, xw)))
    add_adjoint(sc.moment, body, cross(lw, xv) + cross(xw, lv))
    if PARAMETRIC:
        at = offsets.parameter + m.parameters.mass + i - 1
        add_adjoint(sc.parameter, at, neg(dot(lv, xv)))
    return rw, rv, qw, qv


@plain
def body_part(m: Model, sc: Scratch, offsets: Offsets, i: int, touching: int):
    """Parts of body ``i`` and its contacts; returns its own residual wrenches.

    The first is of the solve, the second of its adjoint.

    Reads: m.pairs, m.contact_start, m.contact_stop, m.pair_lead, sc.point,
        sc.change_w, sc.change_v, sc.pair_impulse, sc.pair_w, sc.pair_v,
        sc.multiplier_w, sc.multiplier_v.
    """
    rw, rv, qw, qv = rigid_part(m, sc, offsets, i)
    xw = load(sc.change_w, offsets.solve_body + i)
    xv = load(sc.change_v, offsets.solve_body + i)
    lw = load(sc.multiplier_w, offsets.reading + i)
    lv = load(sc.multiplier_v, offsets.reading + i)
    for c in range(load(m.contact_start, i), load(m.contact_stop, i)):
        r = load(sc.point, offsets.contact + c)
        impulse, back = contact_part(sc, offsets, c, xw, xv, lw, lv)
        rw = rw + cross(r, impulse)
        rv = rv + impulse
        qw = qw + cross(r, back)
        qv = qv + back
    if PAIRS:
        for j in range(m.pairs):
            side = pair_side(m, j, i)
            if side != scalar(0.0):
                qw = qw + side * load(sc.pair_w, offsets.pair + j)
                qv = qv + side * load(sc.pair_v, offsets.pair + j)
                if touching > 0:
                    lead = offsets.contact + load(m.pair_lead, j)
                    impulse = side * load(sc.pair_impulse, offsets.pair + j)
                    rw = rw + cross(load(sc.point, lead), impulse)
                    rv = rv + impulse
    return rw, rv, qw, qv


@plain
def keep_residual(m: Model, sc: Scratch, offsets: Offsets, i: int, touching: int):
    """Leave body ``i``'s residual wrenches where its joint leaves its subtree's.

    That is where joints pass wrenches on, and the place of the body's multipliers.

    Reads: m.joint_kind.
    Writes: sc.passed_w, sc.passed_v, sc.multiplier_w, sc.multiplier_v.
    """
    here = offsets.reading + i
    rw, rv, qw, qv = body_part(m, sc, offsets, i, touching)
    if load(m.joint_kind, i) == JointKind.FREE:
        free_part(m, sc, offsets, i)
    store(sc.passed_w, here, rw)
    store(sc.passed_v, here, rv)
    store(sc.multiplier_w, here, qw)
    store(sc.multiplier_v, here, qv)


@plain
def axis_part(
    m: Model,
    sc: Scratch,
    offsets: Offsets,
    i: int,
    rw: vec3,
    rv: vec3,
    qw: vec3,
    qv: vec3,
):
    """Parts of body ``i``'s joint, which has one dof.

    Reads: m.v_start, sc.dv, sc.effort.
    Writes: g.axis_w, g.axis_v, g.joint_push, g.joint_weight, g.dv.
    """
    k = load(m.v_start, i)
    dof = offsets.solve_dof + k
    dv = load(sc.dv, dof)
    multiplier = load(sc.effort, offsets.reading + i)
    add_adjoint(sc.axis_w, offsets.dof + k, multiplier * rw + dv * qw)
    add_adjoint(sc.axis_v, offsets.dof + k, multiplier * rv + dv * qv)
    add_adjoint(sc.joint_push, dof, multiplier)
    add_adjoint(sc.joint_weight, dof, neg(multiplier * dv))
    store_adjoint(sc.dv, dof, real())


@plain
def free_part(
    m: Model,
    sc: Scratch,
    offsets: Offsets,
    i: int,
):
    """Parts of a free root, whose place is also where its forces act.

    Reads: m.v_start, sc.pose, sc.joint_push, sc.change_w, sc.multiplier_w,
        sc.multiplier_v, g.dv.
    Writes: g.pose, g.joint_push, g.dv.
    """
    k = offsets.solve_dof + load(m.v_start, i)
    p = translation(load(sc.pose, offsets.body + i))
    xw = load(sc.change_w, offsets.solve_body + i)
    lw = load(sc.multiplier_w, offsets.reading + i)
    origin = load(sc.multiplier_v, offsets.reading + i) + cross(lw, p)
    asked = vector(
        load_adjoint(sc.dv, k),
        load_adjoint(sc.dv, k + 1),
        load_adjoint(sc.dv, k + 2),
    )
    force = vector(
        load(sc.joint_push, k), load(sc.joint_push, k + 1), load(sc.joint_push, k + 2)
    )
    place = cross(asked, xw) + cross(force, lw)
    add_adjoint(sc.pose, offsets.body + i, rigid(place, quat()))
    for j in range(3):
        add_adjoint(sc.joint_push, k + j, component(origin, j))
        add_adjoint(sc.joint_push, k + 3 + j, component(lw, j))
        store_adjoint(sc.dv, k + j, real())
        store_adjoint(sc.dv, k + 3 + j, real())


@plain
def limb_part(m: Model, sc: Scratch, offsets: Offsets, limb: int, touching: int):
    """Parts of the bodies and joints of a limb, from tip to root.

    Reads: m.joint_kind, m.limb_start, m.limb_body, m.child_start, m.child,
        sc.passed_w, sc.passed_v, sc.multiplier_w, sc.multiplier_v.
    Writes: sc.passed_w, sc.passed_v, sc.multiplier_w, sc.multiplier_v.
    """
    first = load(m.limb_start, limb)
    stop = load(m.limb_start, limb + 1)
    rw_in = vec3()
    rv_in = vec3()
    qw_in = vec3()
    qv_in = vec3()
    for turn in range(stop - first):
        i = load(m.limb_body, stop - 1 - turn)
        here = offsets.reading + i
        if SHARED:
            rw = load(sc.passed_w, here)
            rv = load(sc.passed_v, here)
            qw = load(sc.multiplier_w, here)
            qv = load(sc.multiplier_v, here)
        else:
            rw, rv, qw, qv = body_part(m, sc, offsets, i, touching)
        branch = load(m.child_start, i)
        branches = load(m.child_start, i + 1)
        if turn > 0:
            branches = branch
        for j in range(branch, branches):
            child = offsets.reading + load(m.child, j)
            rw = rw + load(sc.passed_w, child)
            rv = rv + load(sc.passed_v, child)
            qw = qw + load(sc.multiplier_w, child)
            qv = qv + load(sc.multiplier_v, child)
        rw_in = rw + rw_in
        rv_in = rv + rv_in
        qw_in = qw + qw_in
        qv_in = qv + qv_in
        if load(m.joint_kind, i) != JointKind.FREE:
            axis_part(m, sc, offsets, i, rw_in, rv_in, qw_in, qv_in)
        else:
            if SHARED:
                pass
            else:
                free_part(m, sc, offsets, i)
    # a root hands them to nobody
    root = offsets.reading + load(m.limb_body, first)
    store(sc.passed_w, root, rw_in)
    store(sc.passed_v, root, rv_in)
    store(sc.multiplier_w, root, qw_in)
    store(sc.multiplier_v, root, qv_in)
