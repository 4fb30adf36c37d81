"""The kernel that shows how far apart everything is that can touch.

Inputs: ``Coordinates`` of :mod:`.rows`. Outputs: the gap of each contact.
"""

import warp as wp

from . import real, scalar, vec3
from .coordinates import load_coordinates
from .cpp.memory import load, write_output
from .cpp.place import place
from .kinematics import kinematics
from .nearest import touch_obstacle
from .pair import touch_partner
from .structs import Model, Offsets, Scratch, offsets_at
from .world import pack_at


@wp.func
def gap_of(m: Model, sc: Scratch, offsets: Offsets, c: int):
    """Gap of contact ``c``; negative where the two are pressed into each other [m].

    Reads: m.contact_partner, sc.pose.
    """
    _point = vec3()
    _normal = vec3()
    gap = real()
    if load(m.contact_partner, c) < 0:
        _point, _normal, gap = touch_obstacle(m, sc, offsets, c)
    else:
        _point, _normal, gap = touch_partner(m, sc, offsets, c)
    return gap


@wp.kernel(enable_backward=False)
def contact_gaps(
    m: Model,
    first: int,
    slot_stride: int,
    worlds: int,
    lanes: int,
    scratch: Scratch,
    x: wp.array[scalar],
    y: wp.array[scalar],
):
    """Gaps of all contacts.

    Reads: x.
    Writes: y.
    """
    pack = pack_at(wp.tid(), first, worlds, slot_stride, 1)
    sc = place(scratch, pack.column)
    offsets = offsets_at(m, pack.slot, 0, 0, 0)
    load_coordinates(m, sc, sc, offsets, x, x, pack)
    kinematics(m, sc, offsets, 0, 0, 1)
    for c in range(m.nc):
        write_output(
            y, pack.first * m.nc + c, m.nc, pack.count, gap_of(m, sc, offsets, c)
        )
