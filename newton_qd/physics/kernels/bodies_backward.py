"""The adjoint of :mod:`.bodies`."""

import warp as wp

from . import part, real, scalar, sync
from .coordinates import load_coordinates, read_bodies
from .cpp.place import place
from .readings import seed_bodies
from .structs import Model, Offsets, Scratch, offsets_at
from .world import Pack, pack_at


@part
def seed_reverse(
    m: Model, g: Scratch, offsets: Offsets, y_bar: wp.array[scalar], pack: Pack
):
    """Start the reverse pass with the caller's adjoints of the bodies.

    Reads: m.bodies, y_bar.
    Writes: g.pose, g.twist_w, g.position, g.com, g.com_velocity.
    """
    size = m.bodies.size
    at = pack.first * size
    seed_bodies(m, g, offsets, real(), y_bar, m.bodies, at, size, pack.count, 0, 1)


@wp.func_grad(seed_reverse)
def adj_seed_reverse(
    m: Model, g: Scratch, offsets: Offsets, y_bar: wp.array[scalar], pack: Pack
):
    """Nothing: seeding is not part of the kinematics."""
    sync(0)


@wp.kernel
def bodies_backward(
    m: Model,
    first: int,
    slot_stride: int,
    worlds: int,
    lanes: int,
    scratch: Scratch,
    adjoints: Scratch,
    x: wp.array[scalar],
    y_bar: wp.array[scalar],
    x_bar: wp.array[scalar],
):
    """Adjoint of the kinematics; launched with ``adjoint=True``.

    Reads: x, y_bar.
    Writes: x_bar.
    """
    pack = pack_at(wp.tid(), first, worlds, slot_stride, 1)
    sc = place(scratch, pack.column)
    g = place(adjoints, pack.column)
    offsets = offsets_at(m, pack.slot, 1, 0, 0)
    load_coordinates(m, sc, g, offsets, x, x_bar, pack)
    read_bodies(m, sc, offsets)
    seed_reverse(m, g, offsets, y_bar, pack)
