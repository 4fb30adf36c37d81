"""The linear solve of a tree with pairs, and its adjoint, which is a solve as well.

A solve finds the changes of all velocities x of H x = b: H is the mass matrix with the
joints' diagonal D and the weights W of the contacts, b the impulses. With the motion
J_i of body i for unit changes, X_i = J_i x, and the slip u_c = J_c x of a contact,

    H = D + sum J_i^T I_i J_i + sum J_c^T W_c J_c,
    b = t + sum J_i^T w_i + sum J_c^T p_c.

Let y be the adjoint of x, and s_c those of the slips: y + sum J_c^T s_c in all. Then
(Giles 2008, "Collected matrix derivative results", section 2.2.3)

    H l = y + sum J_c^T s_c,    b_bar = l,    H_bar = -l x^T,

because H is symmetric. So the adjoint is one more solve, with vectors only: the factors
of the joints are those of the forward pass (:mod:`.articulation`), and pairs are added
by the same low-rank update (:mod:`.coupling`). The l are the multipliers; those of
bodies and contacts are L_i = J_i l and m_c = J_c l. Of l^T (b - H x) each part takes
its own:

    impulse and diagonal of a joint     l_k,               -l_k x_k
    wrench and inertia of a body        L_i,               -L_i X_i^T
    push and weight of a contact        m_c,               -m_c u_c^T
    its point r                         (p_c - W u_c) x L_w + (s_c - W m_c) x X_w

An axis S of joint k moves all bodies of its subtree: X_j and L_j change by dS x_k and
dS l_k. That gives it the two residual wrenches of the subtree,

    S_bar = l_k sum (w_j - I_j X_j) + x_k sum (-I_j L_j),

with the impulses p_c - W u_c and s_c - W m_c of the contacts among the wrenches. A
sweep to the root and one back find the multipliers (:mod:`.multipliers`); a last one to
the root hands out the parts and adds up the residuals (:mod:`.parts`).
"""

import warp as wp

from . import plain, stage, sync
from .articulation import SHARED, contact_slip, solve_tree
from .coupling import PAIRS, couple_pairs, pairs_touch
from .cpp.memory import load
from .joints import joint_laws
from .multipliers import (
    couple_multipliers,
    hand_back_limb,
    keep_wrench,
    multiplier_limb,
    pair_slip,
    rest_multiplier,
)
from .parts import keep_residual, limb_part, pair_part
from .structs import Model, Offsets, Scratch


@plain
def solve(m: Model, sc: Scratch, offsets: Offsets, lane: int, lanes: int):
    """Changes of all velocities, and of those of contact points.

    Reads: m.nc.
    """
    solve_tree(m, sc, offsets, lane, lanes)
    if PAIRS:
        if pairs_touch(m, sc, offsets) > 0:
            couple_pairs(m, sc, offsets, lane, lanes)
    # read again by the same lanes
    for c in range(lane, m.nc, lanes):
        contact_slip(m, sc, offsets, c)


@wp.func_grad(solve)
def adj_solve(m: Model, sc: Scratch, offsets: Offsets, lane: int, lanes: int):
    """Multipliers, then what inertias, contacts, joints and axes take of them.

    Reads: m.nb, m.pairs, m.levels, m.limb_level.
    """
    sync(lane)
    if lane == 0:
        rest_multiplier(sc, offsets)
    if PAIRS:
        for j in range(lane, m.pairs, lanes):
            pair_slip(m, sc, offsets, j)
        sync(lane)
    if SHARED:
        for i in range(1 + lane, m.nb + 1, lanes):
            keep_wrench(m, sc, offsets, i)
        sync(lane)
    for turn in range(m.levels):
        level = m.levels - 1 - turn
        first = load(m.limb_level, level) + lane
        for limb in range(first, load(m.limb_level, level + 1), lanes):
            hand_back_limb(m, sc, offsets, limb)
        # the lanes of roots go on with them
        if level > 0:
            sync(lane)
    for level in range(m.levels):
        first = load(m.limb_level, level) + lane
        for limb in range(first, load(m.limb_level, level + 1), lanes):
            multiplier_limb(m, sc, offsets, limb)
        sync(lane)
    touching = int(0)
    if PAIRS:
        touching = pairs_touch(m, sc, offsets)
        if touching > 0:
            couple_multipliers(m, sc, offsets, lane, lanes)
            for j in range(lane, m.pairs, lanes):
                pair_part(m, sc, offsets, j)
            sync(lane)
    if SHARED:
        for i in range(1 + lane, m.nb + 1, lanes):
            keep_residual(m, sc, offsets, i, touching)
        sync(lane)
    for turn in range(m.levels):
        level = m.levels - 1 - turn
        first = load(m.limb_level, level) + lane
        for limb in range(first, load(m.limb_level, level + 1), lanes):
            limb_part(m, sc, offsets, limb, touching)
        sync(lane)


@stage
def linear_solve(m: Model, sc: Scratch, offsets: Offsets, lane: int, lanes: int):
    """What joints add, then changes of all velocities."""
    joint_laws(m, sc, offsets, lane, lanes)
    solve(m, sc, offsets, lane, lanes)
