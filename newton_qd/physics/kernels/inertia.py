"""Rigid inertia and bias wrench of each body about O."""

import warp as wp

from . import real, stage
from .memory import constant, load, store
from .structs import Model, Row, Scratch


@stage
def rigid_inertia(m: Model, sc: Scratch, row: Row, i: int):
    """Inertia about O and bias wrench of body ``i``.

    A rigid inertia is (rotational inertia about O, first mass moment, mass); the bias
    wrench is I a + v x* I v (Featherstone 2008, eq. 5.14 and 6.2).
    """
    x = load(sc.pose, row.body + i)
    c = wp.transform_point(x, constant(m.com, i))
    mass = constant(m.mass, i)
    hm = mass * c
    spin = constant(m.inertia, i)
    if load(m.isotropic, i) == 0:
        r = wp.quat_to_matrix(wp.transform_get_rotation(x))
        spin = r * constant(m.inertia, i) * wp.transpose(r)
    io = spin + wp.dot(hm, c) * wp.identity(n=3, dtype=real) - wp.outer(hm, c)
    w = load(sc.twist_w, row.body + i)
    v = load(sc.twist_v, row.body + i)
    aw = load(sc.bias_w, row.body + i)
    av = load(sc.bias_v, row.body + i)
    angular = io * w + wp.cross(hm, v)
    linear = mass * v - wp.cross(hm, w)
    n = io * aw + wp.cross(hm, av) + wp.cross(w, angular) + wp.cross(v, linear)
    f = mass * av - wp.cross(hm, aw) + wp.cross(w, linear)
    store(sc.inertia, row.body + i, io)
    store(sc.moment, row.body + i, hm)
    store(sc.wrench_w, row.body + i, n)
    store(sc.wrench_v, row.body + i, f)
