"""The kernel that shows the impulse of each contact in every substep of a step.

Inputs: a row of a step, as in :mod:`.rows`. Outputs: for each substep and contact the
impulse in world axes, then its normal part.
"""

import warp as wp

from . import scalar
from .cpp.algebra import component
from .cpp.memory import load, write_output
from .cpp.place import place
from .simulate import simulate
from .structs import Model, Scratch, offsets_at
from .world import Pack, load_world, pack_at

wp.set_module_options({"enable_backward": False})


@wp.func
def store_impulses(m: Model, sc: Scratch, pack: Pack, y: wp.array[scalar]):
    """Write the impulses of all contacts of a pack.

    Reads: m.nc, m.substeps, sc.impulse, sc.normal_impulse.
    Writes: y.
    """
    size = 4 * m.nc * m.substeps
    for s in range(m.substeps):
        offsets = offsets_at(m, pack.slot, 0, s, 0)
        for c in range(m.nc):
            at = pack.first * size + 4 * (s * m.nc + c)
            impulse = load(sc.impulse, offsets.report + c)
            normal = load(sc.normal_impulse, offsets.report + c)
            for j in range(3):
                write_output(y, at + j, size, pack.count, component(impulse, j))
            write_output(y, at + 3, size, pack.count, normal)


@wp.kernel
def contact_impulses(
    m: Model,
    first: int,
    slot_stride: int,
    worlds: int,
    lanes: int,
    scratch: Scratch,
    x: wp.array[scalar],
    y: wp.array[scalar],
):
    """Impulses of all contacts in all substeps of a control step.

    Reads: x.
    Writes: y.
    """
    pack = pack_at(wp.tid(), first, worlds, slot_stride, 1)
    sc = place(scratch, pack.column)
    load_world(m, sc, sc, offsets_at(m, pack.slot, 0, 0, 0), pack, x, x, 0, 1)
    simulate(m, sc, pack, x, 0, 0, 1)
    store_impulses(m, sc, pack, y)
