"""Rows of the linear system H dv = b of one solve."""

import warp as wp

from . import real, stage, vec3
from .smooth import gate, penetration
from .structs import Model, Scratch


@wp.func
def rigid_momentum(
    m: Model, sc: Scratch, slot: int, s: int, i: int, w: vec3, v: vec3
):
    """Momentum (angular, linear) of the composite body ``i`` moving with (w, v)."""
    hm = sc.moment[slot, s, i]
    angular = sc.inertia[slot, s, i] * w + wp.cross(hm, v)
    linear = m.composite_mass[i] * v - wp.cross(hm, w)
    return angular, linear


@stage
def equation_row(m: Model, sc: Scratch, slot: int, s: int, t: int, k: int):
    """Row ``k``: mass matrix along the path, contacts, springs, limits, actuator.

    H_kj = S_j . I_c S_k (composite rigid body algorithm, Featherstone 2008, table
    6.2) with the contact weights added to I_c; joint terms are implicit in the new
    velocity and sit on the diagonal.
    """
    i = m.dof_body[k]
    h = m.h
    sw = sc.axis_w[slot, s, k]
    sv = sc.axis_v[slot, s, k]
    wv = sc.added_wv[slot, t, i]
    angular, linear = rigid_momentum(m, sc, slot, s, i, sw, sv)
    angular = angular + sc.added_ww[slot, t, i] * sw + wv * sv
    linear = linear + wp.transpose(wv) * sw + sc.added_vv[slot, t, i] * sv
    vk = sc.v[slot, s, k]
    force = -m.damping[k] * vk
    implicit = h * m.damping[k]
    u = m.dof_control[k]
    if u >= 0:
        force += m.gear[k] * sc.ctrl[slot, u]
    a = m.dof_coordinate[k]
    if a >= 0:
        qk = sc.q[slot, s, a]
        ks = m.stiffness[k]
        force -= ks * (qk + h * vk - m.spring_rest[k])
        kl = m.limit_stiffness[k]
        width = m.limit_smoothing
        lower = qk + h * vk - m.limit_lower[k]
        upper = m.limit_upper[k] - qk - h * vk
        force += kl * (penetration(lower, width) - penetration(upper, width))
        implicit += h * h * (ks + kl * (gate(lower, width) + gate(upper, width)))
    sc.b[slot, t, k] = (
        h
        * (
            force
            - wp.dot(sw, sc.wrench_w[slot, s, i])
            - wp.dot(sv, sc.wrench_v[slot, s, i])
        )
        + wp.dot(sw, sc.push_w[slot, t, i])
        + wp.dot(sv, sc.push_v[slot, t, i])
    )
    last = m.depth[k] - 1
    for d in range(last):
        j = m.path[k, d]
        sc.H[slot, t, k, d] = wp.dot(sc.axis_w[slot, s, j], angular) + wp.dot(
            sc.axis_v[slot, s, j], linear
        )
    sc.H[slot, t, k, last] = (
        wp.dot(sw, angular) + wp.dot(sv, linear) + m.armature[k] + implicit
    )
