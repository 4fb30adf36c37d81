"""Kernel of one control step's adjoint: recompute the step, then walk back."""

import warp as wp

from . import bounds, scalar
from .cpp.place import place
from .simulate import simulate
from .structs import Model, Scratch, offsets_after, offsets_at
from .world import load_world, pack_at, seed_world


@wp.kernel(launch_bounds=bounds)
def step_backward(
    # system
    m: Model,
    first: int,
    slot_stride: int,
    worlds: int,
    lanes: int,
    scratch: Scratch,
    adjoints: Scratch,
    # in
    x: wp.array[scalar],
    y_bar: wp.array[scalar],
    # out
    x_bar: wp.array[scalar],
):
    """Launched with ``adjoint=True``: its forward part fills the scratch again.

    ``adjoints`` are those of the scratch, all zero before and after.

    Reads: x, y_bar.
    Writes: x_bar.
    """
    pack = pack_at(wp.tid(), first, worlds, slot_stride, lanes)
    lane = pack.lane
    sc = place(scratch, pack.column)
    g = place(adjoints, pack.column)
    load_world(m, sc, g, offsets_at(m, pack.slot, 1, 0, 0), pack, x, x_bar, lane, lanes)
    simulate(m, sc, pack, x, 1, lane, lanes)
    offsets = offsets_after(m, pack.slot, 1)
    seed_world(m, sc, g, offsets, pack, y_bar, lane, lanes)
