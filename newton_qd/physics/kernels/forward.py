"""Kernel of one control step, without adjoint."""

import warp as wp

from . import bounds, scalar
from .cpp.place import place
from .simulate import simulate
from .structs import Model, Scratch, offsets_after, offsets_at
from .world import load_world, pack_at, store_world

wp.set_module_options({"enable_backward": False})


@wp.kernel(launch_bounds=bounds)
def step_forward(
    # system
    m: Model,
    first: int,
    slot_stride: int,
    worlds: int,
    lanes: int,
    scratch: Scratch,
    # in
    x: wp.array[scalar],
    # out
    y: wp.array[scalar],
):
    """One control step of worlds from ``first`` on.

    Reads: x.
    Writes: y.
    """
    pack = pack_at(wp.tid(), first, worlds, slot_stride, lanes)
    lane = pack.lane
    sc = place(scratch, pack.column)
    load_world(m, sc, sc, offsets_at(m, pack.slot, 0, 0, 0), pack, x, x, lane, lanes)
    simulate(m, sc, pack, x, 0, lane, lanes)
    store_world(m, sc, offsets_after(m, pack.slot, 0), pack, y, lane, lanes)
