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

from . import pairs, plain, real, scalar, sync, vec3
from .answers import answer, answer_between, answer_body, answer_dof
from .cpp.algebra import add_diagonal, cross, dot, inverse, outer
from .cpp.memory import Vectors, load, store
from .cpp.numbers import occurs, occurs_beside, uniform
from .cpp.operators import add, mul, neg, sub  # noqa: F401
from .structs import Model, Offsets, Scratch

PAIRS = wp.constant(pairs)


@plain
def coupling_at(m: Model, offsets: Offsets, i: int, j: int):
    """Where the coupling of pair ``j`` with the pair ``i`` before it is.

    Reads: m.pairs.
    """
    return (offsets.pair + j) * m.pairs + i


@plain
def point_weight(sc: Scratch, offsets: Offsets, c: int):
    """3 x 3 weight of a contact: impulse per change of the point's velocity [kg].

    Reads: sc.normal, sc.weight_n, sc.weight_t.
    """
    n = load(sc.normal, offsets.contact + c)
    wt = load(sc.weight_t, offsets.solve_contact + c)
    wn = load(sc.weight_n, offsets.solve_contact + c)
    return add_diagonal((wn - wt) * outer(n, n), wt)


@plain
def couple(m: Model, sc: Scratch, offsets: Offsets, i: int, j: int):
    """Impulse of pair ``i`` for pair ``j``'s unit impulses; ``i`` is before ``j``.

    Reads: sc.pair_weight, sc.pair_coupling.
    Writes: sc.pair_coupling.
    """
    weight = load(sc.pair_weight, offsets.pair + i)
    moved = answer_between(m, sc, offsets, i, j)
    for n in range(i):
        before = load(sc.pair_coupling, coupling_at(m, offsets, n, j))
        moved = moved + answer_between(m, sc, offsets, i, n) * before
    store(sc.pair_coupling, coupling_at(m, offsets, i, j), neg(weight * moved))


@plain
def answer_with_pairs(m: Model, sc: Scratch, offsets: Offsets, j: int, i: int):
    """What body ``i`` answers to pair ``j``, with the pairs before it.

    Reads: sc.answer_w, sc.answer_v, sc.pair_coupling.
    Writes: sc.answer_w, sc.answer_v.
    """
    at = answer_body(m, offsets, j) + i
    w = load(sc.answer_w, at)
    v = load(sc.answer_v, at)
    for n in range(j):
        before = answer_body(m, offsets, n) + i
        impulse = load(sc.pair_coupling, coupling_at(m, offsets, n, j))
        w = w + load(sc.answer_w, before) * impulse
        v = v + load(sc.answer_v, before) * impulse
    store(sc.answer_w, at, w)
    store(sc.answer_v, at, v)


@plain
def dof_answer_with_pairs(m: Model, sc: Scratch, offsets: Offsets, j: int, k: int):
    """What dof ``k`` answers to pair ``j``, with the pairs before it.

    Reads: sc.answer_dv, sc.pair_coupling.
    Writes: sc.answer_dv.
    """
    at = answer_dof(m, offsets, j) + k
    dv = load(sc.answer_dv, at)
    for n in range(j):
        before = load(sc.answer_dv, answer_dof(m, offsets, n) + k)
        dv = dv + before * load(sc.pair_coupling, coupling_at(m, offsets, n, j))
    store(sc.answer_dv, at, dv)


@plain
def pair_motion(
    m: Model,
    sc: Scratch,
    offsets: Offsets,
    turn: Vectors,
    move: Vectors,
    first: int,
    impulse: Vectors,
    j: int,
):
    """Relative velocity at pair ``j``'s point, with the impulses of those before it.

    Reads: m.contact_body, m.contact_partner, m.pair_lead, sc.point, move, turn,
        impulse.

    Args:
        m: The model.
        sc: The scratch.
        offsets: Offsets of the solve.
        turn: Angular velocities by the tree alone.
        move: Velocities by the tree alone.
        first: Where the bodies begin in both.
        impulse: Impulses of the pairs before.
        j: The pair.
    """
    lead = load(m.pair_lead, j)
    a = first + load(m.contact_body, lead)
    b = first + load(m.contact_body, load(m.contact_partner, lead))
    r = load(sc.point, offsets.contact + lead)
    moved = load(move, a) - load(move, b) + cross(load(turn, a) - load(turn, b), r)
    for n in range(j):
        before = load(impulse, offsets.pair + n)
        moved = moved + answer_between(m, sc, offsets, j, n) * before
    return moved


@plain
def solve_pair(m: Model, sc: Scratch, offsets: Offsets, j: int):
    """Impulse of pair ``j`` on its first body, and its weight in later pairs.

    Reads: m.pair_lead, sc.push.
    Writes: sc.pair_weight, sc.pair_impulse.
    """
    lead = load(m.pair_lead, j)
    weight = point_weight(sc, offsets, lead)
    own = answer_between(m, sc, offsets, j, j)
    solved = inverse(add_diagonal(weight * own, uniform(scalar(1.0))))
    moved = pair_motion(
        m,
        sc,
        offsets,
        sc.change_w,
        sc.change_v,
        offsets.solve_body,
        sc.pair_impulse,
        j,
    )
    push = load(sc.push, offsets.solve_contact + lead)
    store(sc.pair_weight, offsets.pair + j, solved * weight)
    store(sc.pair_impulse, offsets.pair + j, solved * (push - weight * moved))


@plain
def with_answers(
    m: Model,
    sc: Scratch,
    offsets: Offsets,
    impulse: Vectors,
    i: int,
    w: vec3,
    v: vec3,
):
    """The change (w, v) of body ``i``'s twist, with what it answers to all pairs.

    Reads: m.pairs, sc.answer_w, sc.answer_v, impulse.
    """
    for j in range(m.pairs):
        at = answer_body(m, offsets, j) + i
        acting = load(impulse, offsets.pair + j)
        w = w + load(sc.answer_w, at) * acting
        v = v + load(sc.answer_v, at) * acting
    return w, v


@plain
def answered(m: Model, sc: Scratch, offsets: Offsets, impulse: Vectors, k: int):
    """What dof ``k`` answers to the impulses of all pairs.

    Reads: m.pairs, sc.answer_dv, impulse.
    """
    dv = real()
    for j in range(m.pairs):
        at = answer_dof(m, offsets, j) + k
        dv = dv + dot(load(sc.answer_dv, at), load(impulse, offsets.pair + j))
    return dv


@plain
def pairs_touch(m: Model, sc: Scratch, offsets: Offsets):
    """Number of the pairs, 0 where none acts on any world of the pack or the block.

    Reads: m.pairs, m.pair_lead, sc.load, sc.push_n, sc.weight_n, sc.weight_t.
    """
    acts = int(0)
    for j in range(m.pairs):
        at = offsets.solve_contact + load(m.pair_lead, j)
        acts = acts + (
            occurs(load(sc.load, at))
            + occurs(load(sc.push_n, at))
            + occurs(load(sc.weight_n, at))
            + occurs(load(sc.weight_t, at))
        )
    count = int(0)
    if occurs_beside(acts) > 0:
        count = m.pairs
    return count


@plain
def couple_pairs(m: Model, sc: Scratch, offsets: Offsets, lane: int, lanes: int):
    """Add the pairs to the tree's changes of velocity.

    Reads: m.nb, m.nv, m.pairs, sc.dv, sc.change_w, sc.change_v.
    Writes: sc.dv, sc.change_w, sc.change_v.
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
    for i in range(1 + lane, m.nb + 1, lanes):
        at = offsets.solve_body + i
        w = load(sc.change_w, at)
        v = load(sc.change_v, at)
        w, v = with_answers(m, sc, offsets, sc.pair_impulse, i, w, v)
        store(sc.change_w, at, w)
        store(sc.change_v, at, v)
    for k in range(lane, m.nv, lanes):
        at = offsets.solve_dof + k
        answers = answered(m, sc, offsets, sc.pair_impulse, k)
        store(sc.dv, at, load(sc.dv, at) + answers)
    sync(lane)
