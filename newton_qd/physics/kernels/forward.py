"""Kernel of one control step, without adjoint."""

import warp as wp

from . import real
from .simulate import simulate
from .structs import Model, Scratch, row_at
from .world import detect_fault, load_world, store_impulses, store_state

wp.set_module_options({"enable_backward": False})


@wp.kernel
def step_forward(
    # system
    m: Model,
    first: int,
    slot_stride: int,
    lanes: int,
    sc: Scratch,
    # in
    x: wp.array[real],
    # out
    y: wp.array[real],
):
    """One control step of worlds from ``first`` on; thread = world * lanes + lane."""
    tid = wp.tid()
    n = tid // lanes
    lane = tid - n * lanes
    slot = n * slot_stride
    w = first + n
    load_world(m, sc, sc, row_at(m, slot, 0, 0, 0), slot, x, x, w, lane, lanes)
    simulate(m, sc, slot, 0, lane, lanes)
    detect_fault(m, sc, slot, lane)
    store_state(m, sc, slot, x, y, w, lane, lanes)
    store_impulses(m, sc, slot, y, w, lane, lanes)
