"""What a tree answers to unit impulses of a pair: three vectors to the root and back.

They use the factors of the joints that the solve has left (:mod:`.articulation`).
"""

from newton_qd.physics.kinds import JointKind

from . import mat33, plain, real, scalar, sync
from .cpp.algebra import add_diagonal, outer, skew, translation, transpose, vector
from .cpp.memory import load, store
from .cpp.numbers import uniform
from .cpp.operators import add, mul, sub  # noqa: F401
from .structs import Model, Offsets, Scratch, root_factors


@plain
def answer_body(m: Model, offsets: Offsets, j: int):
    """Where the bodies of pair ``j``'s answers begin.

    Reads: m.nb.
    """
    return (offsets.pair + j) * (m.nb + 1)


@plain
def answer_dof(m: Model, offsets: Offsets, j: int):
    """Where the degrees of freedom of pair ``j``'s answers begin.

    Reads: m.nv.
    """
    return (offsets.pair + j) * m.nv


@plain
def pair_side(m: Model, j: int, i: int):
    """1 for the first body of pair ``j``, -1 for the second, 0 for others.

    Reads: m.contact_body, m.contact_partner, m.pair_lead.
    """
    lead = load(m.pair_lead, j)
    side = scalar(0.0)
    if load(m.contact_body, lead) == i:
        side = scalar(1.0)
    if load(m.contact_body, load(m.contact_partner, lead)) == i:
        side = scalar(-1.0)
    return side


@plain
def gather_unit(m: Model, sc: Scratch, offsets: Offsets, j: int, i: int):
    """Wrenches on body ``i`` of pair ``j``'s unit impulses, with what children hand on.

    A column for each axis of the world. They are where the answers will be.

    Reads: m.v_start, m.child_start, m.child, m.pair_lead, sc.point, sc.lever_w,
        sc.lever_v, sc.answer_w, sc.answer_v, sc.answer_dv.
    Writes: sc.answer_w, sc.answer_v.
    """
    lead = load(m.pair_lead, j)
    side = pair_side(m, j, i)
    n = side * skew(load(sc.point, offsets.contact + lead))
    f = add_diagonal(mat33(), uniform(side))
    first = answer_body(m, offsets, j)
    dofs = answer_dof(m, offsets, j)
    for c in range(load(m.child_start, i), load(m.child_start, i + 1)):
        child = load(m.child, c)
        at = offsets.solve_body + child
        effort = load(sc.answer_dv, dofs + load(m.v_start, child))
        n = n + (load(sc.answer_w, first + child) - outer(load(sc.lever_w, at), effort))
        f = f + (load(sc.answer_v, first + child) - outer(load(sc.lever_v, at), effort))
    store(sc.answer_w, first + i, n)
    store(sc.answer_v, first + i, f)


@plain
def unit_effort(m: Model, sc: Scratch, offsets: Offsets, j: int, i: int):
    """Efforts of the joint of body ``i`` under pair ``j``'s unit impulses.

    Reads: m.v_start, sc.axis_w, sc.axis_v, sc.answer_w, sc.answer_v.
    Writes: sc.answer_dv.
    """
    k = load(m.v_start, i)
    at = answer_body(m, offsets, j) + i
    angular = load(sc.axis_w, offsets.dof + k) * load(sc.answer_w, at)
    linear = load(sc.axis_v, offsets.dof + k) * load(sc.answer_v, at)
    store(sc.answer_dv, answer_dof(m, offsets, j) + k, angular + linear)


@plain
def rest_answer(m: Model, sc: Scratch, offsets: Offsets, j: int):
    """The world answers to no impulse.

    Writes: sc.answer_w, sc.answer_v.
    """
    at = answer_body(m, offsets, j)
    store(sc.answer_w, at, mat33())
    store(sc.answer_v, at, mat33())


@plain
def answer_axis(m: Model, sc: Scratch, offsets: Offsets, j: int, i: int):
    """What a joint with one dof and body ``i`` answer to pair ``j``'s unit impulses.

    Reads: m.body_parent, m.v_start, sc.axis_w, sc.axis_v, sc.lever_w, sc.lever_v,
        sc.share, sc.answer_w, sc.answer_v, sc.answer_dv.
    Writes: sc.answer_w, sc.answer_v, sc.answer_dv.
    """
    at = offsets.solve_body + i
    first = answer_body(m, offsets, j)
    up = first + load(m.body_parent, i)
    k = load(m.v_start, i)
    dof = answer_dof(m, offsets, j) + k
    w = load(sc.answer_w, up)
    v = load(sc.answer_v, up)
    dv = (
        load(sc.share, at) * load(sc.answer_dv, dof)
        - load(sc.lever_w, at) * w
        - load(sc.lever_v, at) * v
    )
    store(sc.answer_dv, dof, dv)
    store(sc.answer_w, first + i, w + outer(load(sc.axis_w, offsets.dof + k), dv))
    store(sc.answer_v, first + i, v + outer(load(sc.axis_v, offsets.dof + k), dv))


@plain
def answer_free(m: Model, sc: Scratch, offsets: Offsets, j: int, i: int):
    """What a free root answers to pair ``j``'s unit impulses.

    Reads: m.v_start, sc.pose, sc.root_ww, sc.root_wv, sc.root_vv, sc.answer_w,
        sc.answer_v.
    Writes: sc.answer_w, sc.answer_v, sc.answer_dv.
    """
    at = answer_body(m, offsets, j) + i
    k = answer_dof(m, offsets, j) + load(m.v_start, i)
    factors = root_factors(m, offsets, i)
    reduced = load(sc.root_wv, factors)
    n = load(sc.answer_w, at)
    f = load(sc.answer_v, at)
    w = load(sc.root_ww, factors) * (n - reduced * f)
    v = load(sc.root_vv, factors) * f - transpose(reduced) * w
    store(sc.answer_w, at, w)
    store(sc.answer_v, at, v)
    origin = v - skew(translation(load(sc.pose, offsets.body + i))) * w
    one = uniform(scalar(1.0))
    none = real()
    x = vector(one, none, none)
    y = vector(none, one, none)
    z = vector(none, none, one)
    store(sc.answer_dv, k, x * origin)
    store(sc.answer_dv, k + 1, y * origin)
    store(sc.answer_dv, k + 2, z * origin)
    store(sc.answer_dv, k + 3, x * w)
    store(sc.answer_dv, k + 4, y * w)
    store(sc.answer_dv, k + 5, z * w)


@plain
def answer_between(m: Model, sc: Scratch, offsets: Offsets, i: int, j: int):
    """Relative velocity at pair ``i``'s point for pair ``j``'s unit impulses.

    Reads: m.contact_body, m.contact_partner, m.pair_lead, sc.point, sc.answer_w,
        sc.answer_v.
    """
    lead = load(m.pair_lead, i)
    first = answer_body(m, offsets, j)
    a = first + load(m.contact_body, lead)
    b = first + load(m.contact_body, load(m.contact_partner, lead))
    turned = load(sc.answer_w, a) - load(sc.answer_w, b)
    moved = load(sc.answer_v, a) - load(sc.answer_v, b)
    return moved - skew(load(sc.point, offsets.contact + lead)) * turned


@plain
def gather_limb(m: Model, sc: Scratch, offsets: Offsets, j: int, limb: int):
    """Wrenches of pair ``j``'s unit impulses on a limb, from tip to root.

    Reads: m.joint_kind, m.limb_start, m.limb_body.
    """
    first = load(m.limb_start, limb)
    stop = load(m.limb_start, limb + 1)
    for turn in range(stop - first):
        i = load(m.limb_body, stop - 1 - turn)
        gather_unit(m, sc, offsets, j, i)
        if load(m.joint_kind, i) != JointKind.FREE:
            unit_effort(m, sc, offsets, j, i)


@plain
def answer_limb(m: Model, sc: Scratch, offsets: Offsets, j: int, limb: int):
    """What a limb answers to pair ``j``'s unit impulses, from root to tip.

    Reads: m.joint_kind, m.limb_start, m.limb_body.
    """
    for p in range(load(m.limb_start, limb), load(m.limb_start, limb + 1)):
        i = load(m.limb_body, p)
        if load(m.joint_kind, i) == JointKind.FREE:
            answer_free(m, sc, offsets, j, i)
        else:
            answer_axis(m, sc, offsets, j, i)


@plain
def answer(m: Model, sc: Scratch, offsets: Offsets, j: int, lane: int, lanes: int):
    """The tree's answer to pair ``j``'s unit impulses: to the root, and back.

    Reads: m.levels, m.roots, m.limb_level.
    """
    if lane == 0:
        rest_answer(m, sc, offsets, j)
    for turn in range(m.levels):
        level = m.levels - 1 - turn
        first = load(m.limb_level, level) + lane
        for limb in range(first, load(m.limb_level, level + 1), lanes):
            gather_limb(m, sc, offsets, j, limb)
        # the lane of the world has the first root as well
        if level > 0 or m.roots > 1:
            sync(lane)
    for level in range(m.levels):
        first = load(m.limb_level, level) + lane
        for limb in range(first, load(m.limb_level, level + 1), lanes):
            answer_limb(m, sc, offsets, j, limb)
        sync(lane)
