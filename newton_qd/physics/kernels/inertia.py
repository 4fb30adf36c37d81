"""Rigid inertia and bias wrench of each body about O."""

from . import stage
from .cpp.algebra import (
    add_diagonal,
    cross,
    dot,
    matrix,
    parallel,
    rotation,
    symmetric,
    transform_point,
    transpose,
)
from .cpp.memory import constant, load, store
from .cpp.operators import add, mul, sub  # noqa: F401
from .parameters import body_inertia, body_mass
from .structs import Model, Offsets, Scratch


@stage
def rigid_inertia(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Inertia of body ``i`` about O.

    A rigid inertia is (rotational inertia about O, first mass moment, mass).

    Reads: m.com, m.isotropic, sc.parameter, sc.pose.
    Writes: sc.inertia, sc.moment.
    """
    x = load(sc.pose, offsets.body + i)
    c = transform_point(x, constant(m.com, i))
    hm = body_mass(m, sc, offsets, i) * c
    spin = body_inertia(m, sc, offsets, i)
    if load(m.isotropic, i) == 0:
        r = matrix(rotation(x))
        spin = r * body_inertia(m, sc, offsets, i) * transpose(r)
    about = add_diagonal(symmetric(spin) - parallel(hm, c), dot(hm, c))
    store(sc.inertia, offsets.body + i, about)
    store(sc.moment, offsets.body + i, hm)


@stage
def bias_wrench(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Bias wrench of body ``i``: I a + v x* I v (Featherstone 2008, eq. 5.14 and 6.2).

    Reads: sc.parameter, sc.inertia, sc.moment, sc.twist_w, sc.twist_v, sc.bias_w,
        sc.bias_v.
    Writes: sc.wrench_w, sc.wrench_v.
    """
    io = load(sc.inertia, offsets.body + i)
    hm = load(sc.moment, offsets.body + i)
    mass = body_mass(m, sc, offsets, i)
    w = load(sc.twist_w, offsets.motion + i)
    v = load(sc.twist_v, offsets.motion + i)
    aw = load(sc.bias_w, offsets.motion + i)
    av = load(sc.bias_v, offsets.motion + i)
    angular = io * w + cross(hm, v)
    linear = mass * v - cross(hm, w)
    n = io * aw + cross(hm, av) + cross(w, angular) + cross(v, linear)
    f = mass * av - cross(hm, aw) + cross(w, linear)
    store(sc.wrench_w, offsets.motion + i, n)
    store(sc.wrench_v, offsets.motion + i, f)
