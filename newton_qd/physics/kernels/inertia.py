"""Rigid and contact inertia, wrenches and pushes, leaves to root."""

import warp as wp

from . import mat33, real, stage, vec3
from .structs import Model, Scratch


@stage
def rigid_inertia(m: Model, sc: Scratch, slot: int, s: int, i: int):
    """Composite inertia about O and bias wrench of body ``i`` and its descendants.

    A rigid inertia is (rotational inertia about O, first mass moment, mass); the bias
    wrench is I a + v x* I v (Featherstone 2008, eq. 5.14 and 6.2).
    """
    x = sc.pose[slot, s, i]
    r = wp.quat_to_matrix(wp.transform_get_rotation(x))
    c = wp.transform_point(x, m.com[i])
    mass = m.mass[i]
    hm = mass * c
    io = r * m.inertia[i] * wp.transpose(r) + (
        wp.dot(hm, c) * wp.identity(n=3, dtype=real) - wp.outer(hm, c)
    )
    w = sc.twist_w[slot, s, i]
    v = sc.twist_v[slot, s, i]
    aw = sc.bias_w[slot, s, i]
    av = sc.bias_v[slot, s, i]
    angular = io * w + wp.cross(hm, v)
    linear = mass * v - wp.cross(hm, w)
    n = io * aw + wp.cross(hm, av) + wp.cross(w, angular) + wp.cross(v, linear)
    f = mass * av - wp.cross(hm, aw) + wp.cross(w, linear)
    # sums of their own: a loop must not change what its surroundings still use
    io_sum = mat33()
    hm_sum = vec3()
    n_sum = vec3()
    f_sum = vec3()
    for j in range(m.child_start[i], m.child_start[i + 1]):
        child = m.child[j]
        io_sum = io_sum + sc.inertia[slot, s, child]
        hm_sum = hm_sum + sc.moment[slot, s, child]
        n_sum = n_sum + sc.wrench_w[slot, s, child]
        f_sum = f_sum + sc.wrench_v[slot, s, child]
    sc.inertia[slot, s, i] = io + io_sum
    sc.moment[slot, s, i] = hm + hm_sum
    sc.wrench_w[slot, s, i] = n + n_sum
    sc.wrench_v[slot, s, i] = f + f_sum


@wp.func
def point_weight(sc: Scratch, slot: int, s: int, t: int, c: int):
    """3 x 3 weight of a contact: impulse per change of contact velocity [kg]."""
    n = sc.normal[slot, s, c]
    wt = sc.weight_t[slot, t, c]
    return (sc.weight_n[slot, t, c] - wt) * wp.outer(n, n) + wt * wp.identity(
        n=3, dtype=real
    )


@stage
def contact_inertia(m: Model, sc: Scratch, slot: int, s: int, t: int, i: int):
    """Contact weights of body ``i`` and its descendants as a spatial inertia about O.

    With R = [r]x: ww = R^T W R, wv = -(W R)^T, vv = W; and the push as a wrench.
    """
    ww = mat33()
    wv = mat33()
    vv = mat33()
    n = vec3()
    f = vec3()
    for c in range(m.contact_start[i], m.contact_start[i + 1]):
        r = sc.point[slot, s, c]
        w_ = point_weight(sc, slot, s, t, c)
        r_ = wp.skew(r)
        wr = w_ * r_
        p = sc.push[slot, t, c]
        ww = ww - r_ * wr
        wv = wv - wp.transpose(wr)
        vv = vv + w_
        n = n + wp.cross(r, p)
        f = f + p
    for j in range(m.child_start[i], m.child_start[i + 1]):
        child = m.child[j]
        ww = ww + sc.added_ww[slot, t, child]
        wv = wv + sc.added_wv[slot, t, child]
        vv = vv + sc.added_vv[slot, t, child]
        n = n + sc.push_w[slot, t, child]
        f = f + sc.push_v[slot, t, child]
    sc.added_ww[slot, t, i] = ww
    sc.added_wv[slot, t, i] = wv
    sc.added_vv[slot, t, i] = vv
    sc.push_w[slot, t, i] = n
    sc.push_v[slot, t, i] = f
