"""Pairs of moving bodies, solved with the tree: low-rank updates of a linear solve.

A pair's impulse J = P - W u depends on the change u of the velocity of its first body
relative to its second, u = D x, where x is the change of all velocities. The tree alone
solves H x = b. With the pair, (H + D^T W D) x = b + D^T P. With the tree's answer to a
unit impulse along each axis, X = H^-1 D^T, and A = D X, the impulse is

    (1 + W A) J = P - W D H^-1 b,     x = H^-1 b + X J

(the Sherman-Morrison-Woodbury formula, Golub and Van Loan 2013, section 2.1.4). X comes
from the factors of the solve: three vectors go to the root and back. Pairs are added
one after the other, and a pair's H is that of the tree with the pairs before it:
X = H^-1 D^T - sum over them of X' (1 + W' A')^-1 W' D' X.

A contact with a fixed obstacle needs none of this: its weight is an added inertia.
"""

import warp as wp

from newton_qd.physics.kinds import JointKind

from . import mat33, pairs, real, scalar, stage, sync, width
from .articulation import point_weight
from .cpp.algebra import (
    add_diagonal,
    dot,
    inverse,
    outer,
    skew,
    translation,
    transpose,
    vector,
)
from .cpp.memory import load, store
from .cpp.numbers import occurs, uniform
from .cpp.operators import add, mul, neg, sub  # noqa: F401
from .structs import Model, Offsets, Scratch

PAIRS = wp.constant(pairs)
# A CPU skips pairs that no world of a pack needs. A GPU does not: worlds of one warp
# wait for each other.
SKIPS = wp.constant(width > 1)
# blocks of a pair's answers
UNIT = wp.constant(0)
TREE = wp.constant(1)
PAIRED = wp.constant(2)


@wp.func
def answer_body(m: Model, offsets: Offsets, j: int, block: int):
    """Where the bodies of a block of pair ``j`` begin.

    Reads: m.nb.
    """
    return (3 * (offsets.pair + j) + block) * (m.nb + 1)


@wp.func
def answer_dof(m: Model, offsets: Offsets, j: int, block: int):
    """Where the degrees of freedom of a block of pair ``j`` begin.

    Reads: m.nv.
    """
    return (3 * (offsets.pair + j) + block) * m.nv


@wp.func
def coupling_at(m: Model, offsets: Offsets, i: int, j: int):
    """Where the coupling of pair ``j`` with the pair ``i`` before it is.

    Reads: m.pairs.
    """
    return (offsets.pair + j) * m.pairs + i


@stage
def gather_unit(m: Model, sc: Scratch, offsets: Offsets, j: int, i: int):
    """Wrenches on body ``i`` of pair ``j``'s unit impulses, with what children hand on.

    A column for each axis of the world.

    Reads: m.pair_lead, m.contact_body, m.contact_partner, m.child_start, m.child,
        m.v_start, sc.point, sc.lever_w, sc.lever_v, sc.answer_w, sc.answer_v,
        sc.answer_dv.
    Writes: sc.answer_w, sc.answer_v.
    """
    lead = load(m.pair_lead, j)
    side = scalar(0.0)
    if load(m.contact_body, lead) == i:
        side = scalar(1.0)
    if load(m.contact_body, load(m.contact_partner, lead)) == i:
        side = scalar(-1.0)
    n = side * skew(load(sc.point, offsets.contact + lead))
    f = add_diagonal(mat33(), uniform(side))
    first = answer_body(m, offsets, j, UNIT)
    dofs = answer_dof(m, offsets, j, UNIT)
    for c in range(load(m.child_start, i), load(m.child_start, i + 1)):
        child = load(m.child, c)
        at = offsets.solve_body + child
        effort = load(sc.answer_dv, dofs + load(m.v_start, child))
        n = n + (load(sc.answer_w, first + child) - outer(load(sc.lever_w, at), effort))
        f = f + (load(sc.answer_v, first + child) - outer(load(sc.lever_v, at), effort))
    store(sc.answer_w, first + i, n)
    store(sc.answer_v, first + i, f)


@stage
def unit_effort(m: Model, sc: Scratch, offsets: Offsets, j: int, i: int):
    """Efforts of the joint of body ``i`` under pair ``j``'s unit impulses.

    Reads: m.v_start, sc.axis_w, sc.axis_v, sc.answer_w, sc.answer_v.
    Writes: sc.answer_dv.
    """
    k = load(m.v_start, i)
    at = answer_body(m, offsets, j, UNIT) + i
    angular = load(sc.axis_w, offsets.dof + k) * load(sc.answer_w, at)
    linear = load(sc.axis_v, offsets.dof + k) * load(sc.answer_v, at)
    store(sc.answer_dv, answer_dof(m, offsets, j, UNIT) + k, angular + linear)


@stage
def rest_answer(m: Model, sc: Scratch, offsets: Offsets, j: int):
    """The world answers to no impulse.

    Writes: sc.answer_w, sc.answer_v.
    """
    at = answer_body(m, offsets, j, TREE)
    store(sc.answer_w, at, mat33())
    store(sc.answer_v, at, mat33())


@stage
def answer_axis(m: Model, sc: Scratch, offsets: Offsets, j: int, i: int):
    """What a joint with one dof and body ``i`` answer to pair ``j``'s unit impulses.

    Reads: m.body_parent, m.v_start, sc.axis_w, sc.axis_v, sc.lever_w, sc.lever_v,
        sc.share, sc.answer_w, sc.answer_v, sc.answer_dv.
    Writes: sc.answer_w, sc.answer_v, sc.answer_dv.
    """
    at = offsets.solve_body + i
    first = answer_body(m, offsets, j, TREE)
    up = first + load(m.body_parent, i)
    k = load(m.v_start, i)
    w = load(sc.answer_w, up)
    v = load(sc.answer_v, up)
    dv = (
        load(sc.share, at) * load(sc.answer_dv, answer_dof(m, offsets, j, UNIT) + k)
        - load(sc.lever_w, at) * w
        - load(sc.lever_v, at) * v
    )
    store(sc.answer_dv, answer_dof(m, offsets, j, TREE) + k, dv)
    store(sc.answer_w, first + i, w + outer(load(sc.axis_w, offsets.dof + k), dv))
    store(sc.answer_v, first + i, v + outer(load(sc.axis_v, offsets.dof + k), dv))


@stage
def answer_free(m: Model, sc: Scratch, offsets: Offsets, j: int, i: int):
    """What a free root answers to pair ``j``'s unit impulses.

    Reads: m.v_start, sc.pose, sc.total_ww, sc.total_wv, sc.total_vv, sc.answer_w,
        sc.answer_v.
    Writes: sc.answer_w, sc.answer_v, sc.answer_dv.
    """
    at = offsets.solve_body + i
    unit = answer_body(m, offsets, j, UNIT) + i
    to = answer_body(m, offsets, j, TREE) + i
    k = answer_dof(m, offsets, j, TREE) + load(m.v_start, i)
    wv = load(sc.total_wv, at)
    n = load(sc.answer_w, unit)
    f = load(sc.answer_v, unit)
    compliance = inverse(load(sc.total_vv, at))
    reduced = wv * compliance
    w = inverse(load(sc.total_ww, at) - reduced * transpose(wv)) * (n - reduced * f)
    v = compliance * (f - transpose(wv) * w)
    store(sc.answer_w, to, w)
    store(sc.answer_v, to, v)
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


@wp.func
def answer_between(
    m: Model, sc: Scratch, offsets: Offsets, i: int, j: int, block: int
) -> mat33:
    """Relative velocity at pair ``i``'s point for pair ``j``'s unit impulses.

    Reads: m.pair_lead, m.contact_body, m.contact_partner, sc.point, sc.answer_w,
        sc.answer_v.
    """
    lead = load(m.pair_lead, i)
    first = answer_body(m, offsets, j, block)
    a = first + load(m.contact_body, lead)
    b = first + load(m.contact_body, load(m.contact_partner, lead))
    turned = load(sc.answer_w, a) - load(sc.answer_w, b)
    moved = load(sc.answer_v, a) - load(sc.answer_v, b)
    return moved - skew(load(sc.point, offsets.contact + lead)) * turned


@stage
def couple(m: Model, sc: Scratch, offsets: Offsets, i: int, j: int):
    """Impulse of pair ``i`` for pair ``j``'s unit impulses; ``i`` is before ``j``.

    Reads: sc.point, sc.answer_w, sc.answer_v, sc.pair_weight, sc.pair_coupling.
    Writes: sc.pair_coupling.
    """
    weight = load(sc.pair_weight, offsets.pair + i)
    impulse = neg(weight * answer_between(m, sc, offsets, i, j, TREE))
    for n in range(i):
        between = answer_between(m, sc, offsets, i, n, PAIRED)
        before = load(sc.pair_coupling, coupling_at(m, offsets, n, j))
        impulse = impulse - weight * (between * before)
    store(sc.pair_coupling, coupling_at(m, offsets, i, j), impulse)


@stage
def answer_with_pairs(m: Model, sc: Scratch, offsets: Offsets, j: int, i: int):
    """What body ``i`` answers to pair ``j``, with the pairs before it.

    Reads: sc.answer_w, sc.answer_v, sc.pair_coupling.
    Writes: sc.answer_w, sc.answer_v.
    """
    at = answer_body(m, offsets, j, TREE) + i
    w = load(sc.answer_w, at)
    v = load(sc.answer_v, at)
    for n in range(j):
        before = answer_body(m, offsets, n, PAIRED) + i
        impulse = load(sc.pair_coupling, coupling_at(m, offsets, n, j))
        w = w + load(sc.answer_w, before) * impulse
        v = v + load(sc.answer_v, before) * impulse
    store(sc.answer_w, answer_body(m, offsets, j, PAIRED) + i, w)
    store(sc.answer_v, answer_body(m, offsets, j, PAIRED) + i, v)


@stage
def dof_answer_with_pairs(m: Model, sc: Scratch, offsets: Offsets, j: int, k: int):
    """What dof ``k`` answers to pair ``j``, with the pairs before it.

    Reads: sc.answer_dv, sc.pair_coupling.
    Writes: sc.answer_dv.
    """
    dv = load(sc.answer_dv, answer_dof(m, offsets, j, TREE) + k)
    for n in range(j):
        before = load(sc.answer_dv, answer_dof(m, offsets, n, PAIRED) + k)
        dv = dv + before * load(sc.pair_coupling, coupling_at(m, offsets, n, j))
    store(sc.answer_dv, answer_dof(m, offsets, j, PAIRED) + k, dv)


@stage
def solve_pair(m: Model, sc: Scratch, offsets: Offsets, j: int):
    """Impulse of pair ``j`` on its first body, and its weight in later pairs.

    Reads: m.pair_lead, m.contact_body, m.contact_partner, sc.normal, sc.point,
        sc.push, sc.weight_n, sc.weight_t, sc.change_w, sc.change_v, sc.answer_w,
        sc.answer_v, sc.pair_impulse.
    Writes: sc.pair_weight, sc.pair_impulse.
    """
    lead = load(m.pair_lead, j)
    weight = point_weight(sc, offsets, lead)
    own = answer_between(m, sc, offsets, j, j, PAIRED)
    solved = inverse(add_diagonal(weight * own, uniform(scalar(1.0))))
    store(sc.pair_weight, offsets.pair + j, solved * weight)
    a = offsets.tree + load(m.contact_body, lead)
    b = offsets.tree + load(m.contact_body, load(m.contact_partner, lead))
    turned = load(sc.change_w, a) - load(sc.change_w, b)
    moved = load(sc.change_v, a) - load(sc.change_v, b)
    moved = moved - skew(load(sc.point, offsets.contact + lead)) * turned
    push = load(sc.push, offsets.solve_contact + lead)
    impulse = solved * (push - weight * moved)
    for n in range(j):
        before = load(sc.pair_impulse, offsets.pair + n)
        between = answer_between(m, sc, offsets, j, n, PAIRED)
        impulse = impulse - solved * (weight * (between * before))
    store(sc.pair_impulse, offsets.pair + j, impulse)


@stage
def change_with_pairs(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Change of body ``i``'s twist, with the impulses of all pairs.

    Reads: m.pairs, sc.change_w, sc.change_v, sc.answer_w, sc.answer_v,
        sc.pair_impulse.
    Writes: sc.change_w, sc.change_v.
    """
    w = load(sc.change_w, offsets.tree + i)
    v = load(sc.change_v, offsets.tree + i)
    for j in range(m.pairs):
        at = answer_body(m, offsets, j, PAIRED) + i
        impulse = load(sc.pair_impulse, offsets.pair + j)
        w = w + load(sc.answer_w, at) * impulse
        v = v + load(sc.answer_v, at) * impulse
    store(sc.change_w, offsets.change + i, w)
    store(sc.change_v, offsets.change + i, v)


@stage
def dof_change_with_pairs(m: Model, sc: Scratch, offsets: Offsets, k: int):
    """Change of the velocity of dof ``k``, with the impulses of all pairs.

    Reads: m.pairs, sc.dv, sc.answer_dv, sc.pair_impulse.
    Writes: sc.dv.
    """
    dv = load(sc.dv, offsets.tree_dof + k)
    for j in range(m.pairs):
        answer = load(sc.answer_dv, answer_dof(m, offsets, j, PAIRED) + k)
        dv = dv + dot(answer, load(sc.pair_impulse, offsets.pair + j))
    store(sc.dv, offsets.change_dof + k, dv)


@stage
def answer(m: Model, sc: Scratch, offsets: Offsets, j: int, lane: int, lanes: int):
    """The tree's answer to pair ``j``'s unit impulses: to the root, and back.

    Reads: m.joint_kind, m.body_levels, m.body_level_start, m.body_level.
    """
    if lane == 0:
        rest_answer(m, sc, offsets, j)
    for n in range(m.body_levels):
        level = m.body_levels - 1 - n
        start = load(m.body_level_start, level)
        for p in range(start + lane, load(m.body_level_start, level + 1), lanes):
            i = load(m.body_level, p)
            gather_unit(m, sc, offsets, j, i)
            if load(m.joint_kind, i) != JointKind.FREE:
                unit_effort(m, sc, offsets, j, i)
        sync(lane)
    for level in range(m.body_levels):
        start = load(m.body_level_start, level)
        for p in range(start + lane, load(m.body_level_start, level + 1), lanes):
            i = load(m.body_level, p)
            if load(m.joint_kind, i) == JointKind.FREE:
                answer_free(m, sc, offsets, j, i)
            else:
                answer_axis(m, sc, offsets, j, i)
        sync(lane)


@wp.func
def pairs_touch(m: Model, sc: Scratch, offsets: Offsets) -> int:
    """Whether a pair acts on some world of the pack: their number, 0 if none does.

    Reads: m.pairs, m.pair_lead, sc.load, sc.push_n, sc.weight_n, sc.weight_t.
    """
    count = int(0)
    for j in range(m.pairs):
        at = offsets.solve_contact + load(m.pair_lead, j)
        count = count + occurs(load(sc.load, at))
        count = count + occurs(load(sc.push_n, at))
        count = count + occurs(load(sc.weight_n, at))
        count = count + occurs(load(sc.weight_t, at))
    return count


@stage
def change_of_tree(sc: Scratch, offsets: Offsets, i: int):
    """Change of body ``i``'s twist, where no pair acts.

    Reads: sc.change_w, sc.change_v.
    Writes: sc.change_w, sc.change_v.
    """
    store(sc.change_w, offsets.change + i, load(sc.change_w, offsets.tree + i))
    store(sc.change_v, offsets.change + i, load(sc.change_v, offsets.tree + i))


@stage
def dof_change_of_tree(sc: Scratch, offsets: Offsets, k: int):
    """Change of the velocity of dof ``k``, where no pair acts.

    Reads: sc.dv.
    Writes: sc.dv.
    """
    store(sc.dv, offsets.change_dof + k, load(sc.dv, offsets.tree_dof + k))


@stage
def skip_pairs(m: Model, sc: Scratch, offsets: Offsets, lane: int, lanes: int):
    """The tree's changes of velocity are the final ones.

    Reads: m.nb, m.nv.
    """
    for i in range(lane, m.nb + 1, lanes):
        change_of_tree(sc, offsets, i)
    for k in range(lane, m.nv, lanes):
        dof_change_of_tree(sc, offsets, k)
    sync(lane)


@stage
def couple_pairs(m: Model, sc: Scratch, offsets: Offsets, lane: int, lanes: int):
    """Add the pairs to the tree's changes of velocity.

    Reads: m.pairs, m.nb, m.nv.
    """
    for j in range(m.pairs):
        answer(m, sc, offsets, j, lane, lanes)
        if lane == 0:
            for i in range(j):
                couple(m, sc, offsets, i, j)
        sync(lane)
        for i in range(lane, m.nb + 1, lanes):
            answer_with_pairs(m, sc, offsets, j, i)
        for k in range(lane, m.nv, lanes):
            dof_answer_with_pairs(m, sc, offsets, j, k)
        sync(lane)
        if lane == 0:
            solve_pair(m, sc, offsets, j)
        sync(lane)
    for i in range(lane, m.nb + 1, lanes):
        change_with_pairs(m, sc, offsets, i)
    for k in range(lane, m.nv, lanes):
        dof_change_with_pairs(m, sc, offsets, k)
    sync(lane)
