"""Rigid and contact inertia, wrenches and pushes, leaves to root."""

import warp as wp

from . import mat33, real, stage, vec3
from .memory import constant, load, store
from .structs import Model, Row, Scratch


@stage
def rigid_inertia(m: Model, sc: Scratch, row: Row, i: int):
    """Composite inertia about O and bias wrench of body ``i`` and its descendants.

    A rigid inertia is (rotational inertia about O, first mass moment, mass); the bias
    wrench is I a + v x* I v (Featherstone 2008, eq. 5.14 and 6.2).
    """
    x = load(sc.pose, row.body + i)
    r = wp.quat_to_matrix(wp.transform_get_rotation(x))
    c = wp.transform_point(x, constant(m.com, i))
    mass = constant(m.mass, i)
    hm = mass * c
    io = r * constant(m.inertia, i) * wp.transpose(r) + (
        wp.dot(hm, c) * wp.identity(n=3, dtype=real) - wp.outer(hm, c)
    )
    w = load(sc.twist_w, row.body + i)
    v = load(sc.twist_v, row.body + i)
    aw = load(sc.bias_w, row.body + i)
    av = load(sc.bias_v, row.body + i)
    angular = io * w + wp.cross(hm, v)
    linear = mass * v - wp.cross(hm, w)
    n = io * aw + wp.cross(hm, av) + wp.cross(w, angular) + wp.cross(v, linear)
    f = mass * av - wp.cross(hm, aw) + wp.cross(w, linear)
    # sums of their own: a loop must not change what its surroundings still use
    io_sum = mat33()
    hm_sum = vec3()
    n_sum = vec3()
    f_sum = vec3()
    for j in range(load(m.child_start, i), load(m.child_start, i + 1)):
        child = load(m.child, j)
        io_sum = io_sum + load(sc.inertia, row.body + child)
        hm_sum = hm_sum + load(sc.moment, row.body + child)
        n_sum = n_sum + load(sc.wrench_w, row.body + child)
        f_sum = f_sum + load(sc.wrench_v, row.body + child)
    store(sc.inertia, row.body + i, io + io_sum)
    store(sc.moment, row.body + i, hm + hm_sum)
    store(sc.wrench_w, row.body + i, n + n_sum)
    store(sc.wrench_v, row.body + i, f + f_sum)


@wp.func
def point_weight(sc: Scratch, row: Row, c: int):
    """3 x 3 weight of a contact: impulse per change of contact velocity [kg]."""
    n = load(sc.normal, row.contact + c)
    wt = load(sc.weight_t, row.solve_contact + c)
    return (load(sc.weight_n, row.solve_contact + c) - wt) * wp.outer(n, n) + wt * wp.identity(
        n=3, dtype=real
    )


@stage
def contact_inertia(m: Model, sc: Scratch, row: Row, i: int):
    """Contact weights of body ``i`` and its descendants as a spatial inertia about O.

    With R = [r]x: ww = R^T W R, wv = -(W R)^T, vv = W; and the push as a wrench.
    """
    ww = mat33()
    wv = mat33()
    vv = mat33()
    n = vec3()
    f = vec3()
    for c in range(load(m.contact_start, i), load(m.contact_start, i + 1)):
        r = load(sc.point, row.contact + c)
        w_ = point_weight(sc, row, c)
        r_ = wp.skew(r)
        wr = w_ * r_
        p = load(sc.push, row.solve_contact + c)
        ww = ww - r_ * wr
        wv = wv - wp.transpose(wr)
        vv = vv + w_
        n = n + wp.cross(r, p)
        f = f + p
    for j in range(load(m.child_start, i), load(m.child_start, i + 1)):
        child = load(m.child, j)
        ww = ww + load(sc.added_ww, row.solve_body + child)
        wv = wv + load(sc.added_wv, row.solve_body + child)
        vv = vv + load(sc.added_vv, row.solve_body + child)
        n = n + load(sc.push_w, row.solve_body + child)
        f = f + load(sc.push_v, row.solve_body + child)
    store(sc.added_ww, row.solve_body + i, ww)
    store(sc.added_wv, row.solve_body + i, wv)
    store(sc.added_vv, row.solve_body + i, vv)
    store(sc.push_w, row.solve_body + i, n)
    store(sc.push_v, row.solve_body + i, f)
