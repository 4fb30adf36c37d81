"""H = L^T D L along the tree, without fill-in, and the solve with its adjoint.

Featherstone 2008, section 6.5. Row k of H and L holds the ancestors of dof k by
level, roots first: entry a belongs to ``path[k, a]``, the last one is the diagonal,
where L keeps 1 / D. One lane eliminates row after row (scatter, contiguous rows);
several lanes gather each entry from the rows below it, in the same order of terms.
"""

import warp as wp

from . import real, sync
from .memory import load, store
from .structs import Model, Row, Scratch


@wp.func
def factorize_serial(m: Model, L: wp.array[real], at: int):
    """Right-looking elimination of L in place, leaves first."""
    for n in range(m.nv):
        k = m.nv - 1 - n
        row = at + k * m.width
        last = load(m.depth, k) - 1
        inverse = real(1.0) / load(L, row + last)
        store(L, row + last, inverse)
        for e in range(last):
            a = last - 1 - e
            above = at + load(m.path, k * m.width + a) * m.width
            factor = load(L, row + a) * inverse
            for b in range(a + 1):
                value = load(L, above + b) - factor * load(L, row + b)
                store(L, above + b, value)
            store(L, row + a, factor)


@wp.func
def factorize_lanes(
    m: Model, H: wp.array[real], L: wp.array[real], at: int, lane: int, lanes: int
):
    """Left-looking: every entry gathers the rows of its descendants, level by level."""
    for n in range(m.dof_levels):
        level = m.dof_levels - 1 - n
        start = load(m.dof_level_start, level)
        rows = load(m.dof_level_start, level + 1) - start
        width = level + 1
        for p in range(lane, rows * width, lanes):
            i = load(m.dof_level, start + p // width)
            b = p % width
            value = load(H, at + i * m.width + b)
            begin = load(m.descendant_start, i)
            for e in range(begin, load(m.descendant_start, i + 1)):
                k = load(m.descendant, e)
                row = at + k * m.width
                # rows below are not normalised yet, but hold 1 / D
                factor = load(L, row + level) * load(L, row + load(m.depth, k) - 1)
                value -= factor * load(L, row + b)
            store(L, at + i * m.width + b, value)
        sync()
        for p in range(lane, rows, lanes):
            row = at + load(m.dof_level, start + p) * m.width
            store(L, row + level, real(1.0) / load(L, row + level))
        sync()
    for k in range(lane, m.nv, lanes):
        row = at + k * m.width
        last = load(m.depth, k) - 1
        inverse = load(L, row + last)
        for b in range(last):
            store(L, row + b, load(L, row + b) * inverse)
    sync()


@wp.func
def substitute_serial(m: Model, L: wp.array[real], at: int, y: wp.array[real], to: int):
    """Overwrite y with (L^T D L)^-1 y, one lane."""
    for n in range(m.nv):
        k = m.nv - 1 - n
        row = at + k * m.width
        last = load(m.depth, k) - 1
        value = load(y, to + k)
        for a in range(last):
            i = to + load(m.path, k * m.width + a)
            store(y, i, load(y, i) - load(L, row + a) * value)
        store(y, to + k, value * load(L, row + last))
    for k in range(m.nv):
        row = at + k * m.width
        value = load(y, to + k)
        for a in range(load(m.depth, k) - 1):
            i = to + load(m.path, k * m.width + a)
            value -= load(L, row + a) * load(y, i)
        store(y, to + k, value)


@wp.func
def substitute_lanes(
    m: Model,
    L: wp.array[real],
    at: int,
    y: wp.array[real],
    to: int,
    lane: int,
    lanes: int,
):
    """Overwrite y with (L^T D L)^-1 y, several lanes."""
    for n in range(m.dof_levels):
        level = m.dof_levels - 1 - n
        start = load(m.dof_level_start, level)
        for p in range(start + lane, load(m.dof_level_start, level + 1), lanes):
            i = load(m.dof_level, p)
            value = load(y, to + i)
            begin = load(m.descendant_start, i)
            for e in range(begin, load(m.descendant_start, i + 1)):
                k = load(m.descendant, e)
                value -= load(L, at + k * m.width + level) * load(y, to + k)
            store(y, to + i, value)
        sync()
    for level in range(m.dof_levels):
        start = load(m.dof_level_start, level)
        for p in range(start + lane, load(m.dof_level_start, level + 1), lanes):
            k = load(m.dof_level, p)
            row = at + k * m.width
            value = load(y, to + k) * load(L, row + level)
            for a in range(level):
                i = to + load(m.path, k * m.width + a)
                value -= load(L, row + a) * load(y, i)
            store(y, to + k, value)
        sync()


@wp.func
def substitute(
    m: Model,
    L: wp.array[real],
    at: int,
    y: wp.array[real],
    to: int,
    lane: int,
    lanes: int,
):
    """Overwrite y with (L^T D L)^-1 y; L begins at ``at`` and y at ``to``."""
    if lanes == 1:
        substitute_serial(m, L, at, y, to)
    else:
        substitute_lanes(m, L, at, y, to, lane, lanes)


@wp.func
def solve(m: Model, sc: Scratch, g: Scratch, row: Row, lane: int, lanes: int):
    """Write dv = H^-1 b; ``g`` holds the adjoints of ``sc``."""
    for k in range(lane, m.nv, lanes):
        store(sc.dv, row.solve_dof + k, load(sc.b, row.solve_dof + k))
    if lanes == 1:
        for k in range(m.nv * m.width):
            store(sc.L, row.matrix + k, load(sc.H, row.matrix + k))
        factorize_serial(m, sc.L, row.matrix)
    else:
        factorize_lanes(m, sc.H, sc.L, row.matrix, lane, lanes)
    substitute(m, sc.L, row.matrix, sc.dv, row.solve_dof, lane, lanes)


@wp.func_grad(solve)
def adj_solve(m: Model, sc: Scratch, g: Scratch, row: Row, lane: int, lanes: int):
    """b_bar = H^-1 dv_bar; H_bar = -b_bar dv^T, both halves on the stored one."""
    for k in range(lane, m.nv, lanes):
        store(g.b, row.solve_dof + k, load(g.dv, row.solve_dof + k))
        store(g.dv, row.solve_dof + k, real(0.0))
    sync()
    substitute(m, sc.L, row.matrix, g.b, row.solve_dof, lane, lanes)
    for k in range(lane, m.nv, lanes):
        bk = load(g.b, row.solve_dof + k)
        xk = load(sc.dv, row.solve_dof + k)
        last = load(m.depth, k) - 1
        at = row.matrix + k * m.width
        for a in range(last):
            j = row.solve_dof + load(m.path, k * m.width + a)
            store(g.H, at + a, -(bk * load(sc.dv, j) + load(g.b, j) * xk))
        store(g.H, at + last, -bk * xk)
    sync()


solve.skip_replay = True
