"""The kernel that shows where the bodies are and how they move.

Inputs and outputs are rows as in :mod:`.rows`: ``Coordinates`` and ``Bodies``.
"""

import warp as wp

from . import scalar
from .coordinates import load_coordinates, read_bodies
from .cpp.place import place
from .readings import store_bodies
from .structs import Model, Scratch, offsets_at
from .world import pack_at


@wp.kernel(enable_backward=False)
def bodies_forward(
    m: Model,
    first: int,
    slot_stride: int,
    worlds: int,
    lanes: int,
    scratch: Scratch,
    x: wp.array[scalar],
    y: wp.array[scalar],
):
    """Where the bodies are and how they move.

    Reads: x.
    Writes: y.
    """
    pack = pack_at(wp.tid(), first, worlds, slot_stride, 1)
    sc = place(scratch, pack.column)
    offsets = offsets_at(m, pack.slot, 0, 0, 0)
    load_coordinates(m, sc, sc, offsets, x, x, pack)
    read_bodies(m, sc, offsets)
    size = m.bodies.size
    at = pack.first * size
    store_bodies(m, sc, offsets, y, m.bodies, at, size, pack.count, 0, 1)
