"""What kernels share that show a system at given coordinates and velocities.

They read ``Coordinates`` of :mod:`.rows`. Each of them is a module of its own, because
Warp compiles whole modules: a reset shows the bodies, and needs neither their adjoint
nor the mass matrix.
"""

import warp as wp

from . import part, real, scalar
from .cpp.memory import load, read_input, store, write_output
from .kinematics import kinematics
from .readings import body_reading
from .structs import Model, Offsets, Scratch
from .world import Pack


@part
def load_coordinates(
    m: Model,
    sc: Scratch,
    g: Scratch,
    offsets: Offsets,
    x: wp.array[scalar],
    x_bar: wp.array[scalar],
    pack: Pack,
):
    """Copy coordinates and velocities of a pack into its slot.

    Reads: m.nq, m.nv, m.coordinates, x.
    Writes: sc.q, sc.v.
    """
    size = m.coordinates.size
    q = pack.first * size + m.coordinates.q
    v = pack.first * size + m.coordinates.v
    for k in range(m.nq):
        store(sc.q, offsets.q + k, read_input(x, q + k, size, pack.count))
    for k in range(m.nv):
        store(sc.v, offsets.v + k, read_input(x, v + k, size, pack.count))


@wp.func_grad(load_coordinates)
def adj_load_coordinates(
    m: Model,
    sc: Scratch,
    g: Scratch,
    offsets: Offsets,
    x: wp.array[scalar],
    x_bar: wp.array[scalar],
    pack: Pack,
):
    """Hand the adjoints of coordinates and velocities to the caller.

    Reads: m.nq, m.nv, m.coordinates, g.q, g.v.
    Writes: g.q, g.v, x_bar.
    """
    size = m.coordinates.size
    q = pack.first * size + m.coordinates.q
    v = pack.first * size + m.coordinates.v
    for k in range(m.nq):
        write_output(x_bar, q + k, size, pack.count, load(g.q, offsets.q + k))
        store(g.q, offsets.q + k, real())
    for k in range(m.nv):
        write_output(x_bar, v + k, size, pack.count, load(g.v, offsets.v + k))
        store(g.v, offsets.v + k, real())


@part
def read_bodies(m: Model, sc: Scratch, offsets: Offsets):
    """Kinematics of substep 0 with one lane; replayed by the adjoint kernel.

    Reads: m.nb.
    """
    kinematics(m, sc, offsets, 0, 0, 1)
    for i in range(1, m.nb + 1):
        body_reading(m, sc, offsets, i)
