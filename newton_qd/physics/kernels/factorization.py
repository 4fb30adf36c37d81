"""H = L^T D L along the tree, without fill-in, and the solve with its adjoint.

Featherstone 2008, section 6.5. Row k of H and L holds the ancestors of dof k by
level, roots first: entry a belongs to ``path[k, a]``, the last one is the diagonal,
where L keeps 1 / D. One lane eliminates row after row (scatter, contiguous rows);
several lanes gather each entry from the rows below it, in the same order of terms.
"""

import warp as wp

from . import real, sync
from .structs import Model, Scratch


@wp.func
def factorize_serial(m: Model, L: wp.array4d[real], slot: int, t: int):
    """Right-looking elimination of L in place, leaves first."""
    for n in range(m.nv):
        k = m.nv - 1 - n
        last = m.depth[k] - 1
        inverse = real(1.0) / L[slot, t, k, last]
        L[slot, t, k, last] = inverse
        for e in range(last):
            a = last - 1 - e
            i = m.path[k, a]
            factor = L[slot, t, k, a] * inverse
            for b in range(a + 1):
                L[slot, t, i, b] = L[slot, t, i, b] - factor * L[slot, t, k, b]
            L[slot, t, k, a] = factor


@wp.func
def factorize_lanes(
    m: Model,
    H: wp.array4d[real],
    L: wp.array4d[real],
    slot: int,
    t: int,
    lane: int,
    lanes: int,
):
    """Left-looking: every entry gathers the rows of its descendants, level by level."""
    for n in range(m.dof_levels):
        level = m.dof_levels - 1 - n
        start = m.dof_level_start[level]
        rows = m.dof_level_start[level + 1] - start
        width = level + 1
        for p in range(lane, rows * width, lanes):
            i = m.dof_level[start + p // width]
            b = p % width
            value = H[slot, t, i, b]
            for e in range(m.descendant_start[i], m.descendant_start[i + 1]):
                k = m.descendant[e]
                # rows below hold L; L D = the entry before its normalisation
                diagonal = L[slot, t, k, m.depth[k] - 1]
                value = value - L[slot, t, k, level] * (L[slot, t, k, b] / diagonal)
            L[slot, t, i, b] = value
        sync()
        for p in range(lane, rows, lanes):
            i = m.dof_level[start + p]
            inverse = real(1.0) / L[slot, t, i, level]
            L[slot, t, i, level] = inverse
            for b in range(level):
                L[slot, t, i, b] = L[slot, t, i, b] * inverse
        sync()


@wp.func
def substitute_serial(
    m: Model, L: wp.array4d[real], y: wp.array3d[real], slot: int, t: int
):
    """Overwrite y with (L^T D L)^-1 y, one lane."""
    for n in range(m.nv):
        k = m.nv - 1 - n
        last = m.depth[k] - 1
        value = y[slot, t, k]
        for a in range(last):
            i = m.path[k, a]
            y[slot, t, i] = y[slot, t, i] - L[slot, t, k, a] * value
        y[slot, t, k] = value * L[slot, t, k, last]
    for k in range(m.nv):
        value = y[slot, t, k]
        for a in range(m.depth[k] - 1):
            value = value - L[slot, t, k, a] * y[slot, t, m.path[k, a]]
        y[slot, t, k] = value


@wp.func
def substitute_lanes(
    m: Model,
    L: wp.array4d[real],
    y: wp.array3d[real],
    slot: int,
    t: int,
    lane: int,
    lanes: int,
):
    """Overwrite y with (L^T D L)^-1 y, several lanes."""
    for n in range(m.dof_levels):
        level = m.dof_levels - 1 - n
        for p in range(
            m.dof_level_start[level] + lane, m.dof_level_start[level + 1], lanes
        ):
            i = m.dof_level[p]
            value = y[slot, t, i]
            for e in range(m.descendant_start[i], m.descendant_start[i + 1]):
                k = m.descendant[e]
                value = value - L[slot, t, k, level] * y[slot, t, k]
            y[slot, t, i] = value
        sync()
    for level in range(m.dof_levels):
        for p in range(
            m.dof_level_start[level] + lane, m.dof_level_start[level + 1], lanes
        ):
            k = m.dof_level[p]
            value = y[slot, t, k] * L[slot, t, k, level]
            for a in range(level):
                value = value - L[slot, t, k, a] * y[slot, t, m.path[k, a]]
            y[slot, t, k] = value
        sync()


@wp.func
def substitute(
    m: Model,
    L: wp.array4d[real],
    y: wp.array3d[real],
    slot: int,
    t: int,
    lane: int,
    lanes: int,
):
    """Overwrite y with (L^T D L)^-1 y."""
    if lanes == 1:
        substitute_serial(m, L, y, slot, t)
    else:
        substitute_lanes(m, L, y, slot, t, lane, lanes)


@wp.func
def solve(m: Model, sc: Scratch, g: Scratch, slot: int, t: int, lane: int, lanes: int):
    """Write dv = H^-1 b; ``g`` holds the adjoints of ``sc``."""
    for k in range(lane, m.nv, lanes):
        sc.dv[slot, t, k] = sc.b[slot, t, k]
    if lanes == 1:
        for k in range(m.nv):
            for a in range(m.depth[k]):
                sc.L[slot, t, k, a] = sc.H[slot, t, k, a]
        factorize_serial(m, sc.L, slot, t)
    else:
        factorize_lanes(m, sc.H, sc.L, slot, t, lane, lanes)
    substitute(m, sc.L, sc.dv, slot, t, lane, lanes)


@wp.func_grad(solve)
def adj_solve(
    m: Model, sc: Scratch, g: Scratch, slot: int, t: int, lane: int, lanes: int
):
    """b_bar = H^-1 dv_bar; H_bar = -b_bar dv^T, both halves on the stored one."""
    for k in range(lane, m.nv, lanes):
        g.b[slot, t, k] = g.dv[slot, t, k]
        g.dv[slot, t, k] = real(0.0)
    sync()
    substitute(m, sc.L, g.b, slot, t, lane, lanes)
    for k in range(lane, m.nv, lanes):
        bk = g.b[slot, t, k]
        xk = sc.dv[slot, t, k]
        last = m.depth[k] - 1
        for a in range(last):
            j = m.path[k, a]
            g.H[slot, t, k, a] = -(bk * sc.dv[slot, t, j] + g.b[slot, t, j] * xk)
        g.H[slot, t, k, last] = -bk * xk
    sync()


solve.skip_replay = True
