"""Kernel of one control step's adjoint: recompute the step, then walk back."""

import warp as wp

from . import real
from .simulate import simulate
from .structs import Model, Scratch, row_at
from .world import detect_fault, load_world, seed_world


@wp.kernel
def step_backward(
    # system
    m: Model,
    first: int,
    slot_stride: int,
    lanes: int,
    sc: Scratch,
    g: Scratch,
    # in
    x: wp.array[real],
    y_bar: wp.array[real],
    # out
    x_bar: wp.array[real],
):
    """Launched with ``adjoint=True``: its forward part fills the scratch again.

    ``g`` is the adjoint of ``sc``, all zero before and after.
    """
    tid = wp.tid()
    n = tid // lanes
    lane = tid - n * lanes
    slot = n * slot_stride
    w = first + n
    load_world(m, sc, g, row_at(m, slot, 1, 0, 0), slot, x, x_bar, w, lane, lanes)
    simulate(m, sc, slot, 1, lane, lanes)
    detect_fault(m, sc, slot, lane)
    seed_world(m, sc, g, slot, y_bar, w, lane, lanes)
