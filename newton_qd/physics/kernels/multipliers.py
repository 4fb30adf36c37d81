"""The multipliers of a linear solve's adjoint: :mod:`.solve` has the derivation.

They are the changes that the adjoints of changes would cause, were they impulses.
"""

from newton_qd.physics.kinds import JointKind

from . import plain, scalar, sync, vec3
from .answers import pair_side
from .articulation import SHARED
from .coupling import PAIRS, answered, pair_motion, with_answers
from .cpp.algebra import cross, dot, translation, vector
from .cpp.memory import add_adjoint, load, load_adjoint, store, store_adjoint
from .cpp.operators import add, mul, neg, sub  # noqa: F401
from .structs import Model, Offsets, Scratch, root_factors


@plain
def pair_slip(m: Model, sc: Scratch, offsets: Offsets, j: int):
    """Wrench on pair ``j``'s first body of the adjoints of both its slips; clears them.

    Both sides slip relative to the other, each at its own point.

    Reads: m.contact_body, m.contact_partner, m.pair_lead, sc.point, sc.change_w,
        g.slip.
    Writes: sc.pair_w, sc.pair_v, g.point, g.slip.
    """
    a = load(m.pair_lead, j)
    b = load(m.contact_partner, a)
    one = load_adjoint(sc.slip, offsets.solve_contact + a)
    other = load_adjoint(sc.slip, offsets.solve_contact + b)
    turned = load(sc.change_w, offsets.solve_body + load(m.contact_body, a)) - load(
        sc.change_w, offsets.solve_body + load(m.contact_body, b)
    )
    r = load(sc.point, offsets.contact + a)
    there = load(sc.point, offsets.contact + b)
    store(sc.pair_w, offsets.pair + j, cross(r, one) - cross(there, other))
    store(sc.pair_v, offsets.pair + j, one - other)
    add_adjoint(sc.point, offsets.contact + a, cross(one, turned))
    add_adjoint(sc.point, offsets.contact + b, cross(turned, other))
    store_adjoint(sc.slip, offsets.solve_contact + a, vec3())
    store_adjoint(sc.slip, offsets.solve_contact + b, vec3())


@plain
def adjoint_wrench(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Wrench on body ``i`` of the adjoints of slips.

    Reads: m.pairs, m.contact_start, m.contact_stop, sc.point, sc.pair_w, sc.pair_v,
        g.slip.
    """
    n = vec3()
    f = vec3()
    for c in range(load(m.contact_start, i), load(m.contact_stop, i)):
        slip = load_adjoint(sc.slip, offsets.solve_contact + c)
        n = n + cross(load(sc.point, offsets.contact + c), slip)
        f = f + slip
    if PAIRS:
        for j in range(m.pairs):
            side = pair_side(m, j, i)
            if side != scalar(0.0):
                n = n + side * load(sc.pair_w, offsets.pair + j)
                f = f + side * load(sc.pair_v, offsets.pair + j)
    return n, f


@plain
def keep_wrench(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Leave body ``i``'s wrench where its joint leaves what it hands on.

    Writes: sc.passed_w, sc.passed_v.
    """
    w, v = adjoint_wrench(m, sc, offsets, i)
    store(sc.passed_w, offsets.reading + i, w)
    store(sc.passed_v, offsets.reading + i, v)


@plain
def hand_back_axis(m: Model, sc: Scratch, offsets: Offsets, i: int, n: vec3, f: vec3):
    """The adjoint's effort of a joint with one dof; returns what is passed on.

    Reads: m.v_start, sc.axis_w, sc.axis_v, sc.lever_w, sc.lever_v, sc.share, g.dv.
    Writes: sc.effort.
    """
    at = offsets.solve_body + i
    k = load(m.v_start, i)
    effort = (
        load_adjoint(sc.dv, offsets.solve_dof + k)
        + dot(load(sc.axis_w, offsets.dof + k), n)
        + dot(load(sc.axis_v, offsets.dof + k), f)
    )
    store(sc.effort, offsets.reading + i, load(sc.share, at) * effort)
    return n - effort * load(sc.lever_w, at), f - effort * load(sc.lever_v, at)


@plain
def multiplier_free(m: Model, sc: Scratch, offsets: Offsets, i: int, n: vec3, f: vec3):
    """Multipliers of a free root.

    Reads: m.v_start, sc.pose, sc.root_ww, sc.root_wv, sc.root_vv, g.dv.
    Writes: sc.multiplier_w, sc.multiplier_v.
    """
    k = offsets.solve_dof + load(m.v_start, i)
    p = translation(load(sc.pose, offsets.body + i))
    origin = vector(
        load_adjoint(sc.dv, k),
        load_adjoint(sc.dv, k + 1),
        load_adjoint(sc.dv, k + 2),
    )
    turn = vector(
        load_adjoint(sc.dv, k + 3),
        load_adjoint(sc.dv, k + 4),
        load_adjoint(sc.dv, k + 5),
    )
    n = n + turn + cross(p, origin)
    f = f + origin
    factors = root_factors(m, offsets, i)
    reduced = load(sc.root_wv, factors)
    w = load(sc.root_ww, factors) * (n - reduced * f)
    v = load(sc.root_vv, factors) * f - w * reduced
    store(sc.multiplier_w, offsets.reading + i, w)
    store(sc.multiplier_v, offsets.reading + i, v)


@plain
def rest_multiplier(sc: Scratch, offsets: Offsets):
    """The world does not move.

    Writes: sc.multiplier_w, sc.multiplier_v.
    """
    store(sc.multiplier_w, offsets.reading, vec3())
    store(sc.multiplier_v, offsets.reading, vec3())


@plain
def multiplier_axis(m: Model, sc: Scratch, offsets: Offsets, i: int, w: vec3, v: vec3):
    """Multipliers of a joint with one dof, in the place of its effort, and its body.

    ``w`` and ``v`` are those of the parent; the body's are returned.

    Reads: m.v_start, sc.axis_w, sc.axis_v, sc.lever_w, sc.lever_v, sc.effort.
    Writes: sc.effort, sc.multiplier_w, sc.multiplier_v.
    """
    at = offsets.solve_body + i
    here = offsets.reading + i
    k = load(m.v_start, i)
    dv = (
        load(sc.effort, here)
        - dot(load(sc.lever_w, at), w)
        - dot(load(sc.lever_v, at), v)
    )
    w = w + dv * load(sc.axis_w, offsets.dof + k)
    v = v + dv * load(sc.axis_v, offsets.dof + k)
    store(sc.effort, here, dv)
    store(sc.multiplier_w, here, w)
    store(sc.multiplier_v, here, v)
    return w, v


@plain
def hand_back_limb(m: Model, sc: Scratch, offsets: Offsets, limb: int):
    """Hand the adjoint's wrenches of a limb back, from tip to root.

    Reads: m.joint_kind, m.body_parent, m.limb_start, m.limb_body, m.child_start,
        m.child, sc.passed_w, sc.passed_v.
    Writes: sc.passed_w, sc.passed_v.
    """
    first = load(m.limb_start, limb)
    stop = load(m.limb_start, limb + 1)
    w_in = vec3()
    v_in = vec3()
    for turn in range(stop - first):
        i = load(m.limb_body, stop - 1 - turn)
        if SHARED:
            w = load(sc.passed_w, offsets.reading + i)
            v = load(sc.passed_v, offsets.reading + i)
        else:
            w, v = adjoint_wrench(m, sc, offsets, i)
        branch = load(m.child_start, i)
        branches = load(m.child_start, i + 1)
        if turn > 0:
            branches = branch
        for j in range(branch, branches):
            child = offsets.reading + load(m.child, j)
            w = w + load(sc.passed_w, child)
            v = v + load(sc.passed_v, child)
        w = w + w_in
        v = v + v_in
        if load(m.joint_kind, i) == JointKind.FREE:
            multiplier_free(m, sc, offsets, i, w, v)
        else:
            w_in, v_in = hand_back_axis(m, sc, offsets, i, w, v)
    root = load(m.limb_body, first)
    if load(m.body_parent, root) > 0:
        store(sc.passed_w, offsets.reading + root, w_in)
        store(sc.passed_v, offsets.reading + root, v_in)


@plain
def multiplier_limb(m: Model, sc: Scratch, offsets: Offsets, limb: int):
    """Multipliers of a limb, from root to tip.

    Reads: m.joint_kind, m.body_parent, m.limb_start, m.limb_body, sc.multiplier_w,
        sc.multiplier_v.
    """
    first = load(m.limb_start, limb)
    root = load(m.limb_body, first)
    if load(m.joint_kind, root) == JointKind.FREE:
        first = first + 1
        up = offsets.reading + root
    else:
        up = offsets.reading + load(m.body_parent, root)
    w = load(sc.multiplier_w, up)
    v = load(sc.multiplier_v, up)
    for p in range(first, load(m.limb_start, limb + 1)):
        w, v = multiplier_axis(m, sc, offsets, load(m.limb_body, p), w, v)


@plain
def couple_multipliers(m: Model, sc: Scratch, offsets: Offsets, lane: int, lanes: int):
    """Add the pairs to the tree's multipliers: as to its changes, without a push.

    Reads: m.nb, m.pairs, m.joint_kind, m.v_start, sc.pair_weight, sc.effort,
        sc.multiplier_w, sc.multiplier_v.
    Writes: sc.pair_adjoint, sc.effort, sc.multiplier_w, sc.multiplier_v.
    """
    if lane == 0:
        for j in range(m.pairs):
            weight = load(sc.pair_weight, offsets.pair + j)
            moved = pair_motion(
                m,
                sc,
                offsets,
                sc.multiplier_w,
                sc.multiplier_v,
                offsets.reading,
                sc.pair_adjoint,
                j,
            )
            store(sc.pair_adjoint, offsets.pair + j, neg(weight * moved))
    sync(lane)
    for i in range(1 + lane, m.nb + 1, lanes):
        here = offsets.reading + i
        w = load(sc.multiplier_w, here)
        v = load(sc.multiplier_v, here)
        w, v = with_answers(m, sc, offsets, sc.pair_adjoint, i, w, v)
        store(sc.multiplier_w, here, w)
        store(sc.multiplier_v, here, v)
        if load(m.joint_kind, i) != JointKind.FREE:
            k = load(m.v_start, i)
            dv = load(sc.effort, here)
            store(sc.effort, here, dv + answered(m, sc, offsets, sc.pair_adjoint, k))
    sync(lane)
