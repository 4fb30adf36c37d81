"""Rows of the linear system H dv = b of one solve."""

import warp as wp

from . import real, stage, vec3
from .smooth import gate, penetration
from .memory import constant, load, store
from .structs import Model, Row, Scratch


@wp.func
def rigid_momentum(
    m: Model, sc: Scratch, row: Row, i: int, w: vec3, v: vec3
):
    """Momentum (angular, linear) of the composite body ``i`` moving with (w, v)."""
    hm = load(sc.moment, row.body + i)
    angular = load(sc.inertia, row.body + i) * w + wp.cross(hm, v)
    linear = constant(m.composite_mass, i) * v - wp.cross(hm, w)
    return angular, linear


@stage
def equation_row(m: Model, sc: Scratch, row: Row, k: int):
    """Row ``k``: mass matrix along the path, contacts, springs, limits, actuator.

    H_kj = S_j . I_c S_k (composite rigid body algorithm, Featherstone 2008, table
    6.2) with the contact weights added to I_c; joint terms are implicit in the new
    velocity and sit on the diagonal.
    """
    i = load(m.dof_body, k)
    h = m.h
    sw = load(sc.axis_w, row.dof + k)
    sv = load(sc.axis_v, row.dof + k)
    wv = load(sc.added_wv, row.solve_body + i)
    angular, linear = rigid_momentum(m, sc, row, i, sw, sv)
    angular = angular + load(sc.added_ww, row.solve_body + i) * sw + wv * sv
    linear = linear + wp.transpose(wv) * sw + load(sc.added_vv, row.solve_body + i) * sv
    vk = load(sc.v, row.v + k)
    force = -constant(m.damping, k) * vk
    implicit = h * constant(m.damping, k)
    u = load(m.dof_control, k)
    if u >= 0:
        force += constant(m.gear, k) * load(sc.ctrl, row.ctrl + u)
    a = load(m.dof_coordinate, k)
    if a >= 0:
        qk = load(sc.q, row.q + a)
        ks = constant(m.stiffness, k)
        force -= ks * (qk + h * vk - constant(m.spring_rest, k))
        kl = constant(m.limit_stiffness, k)
        width = m.limit_smoothing
        lower = qk + h * vk - constant(m.limit_lower, k)
        upper = constant(m.limit_upper, k) - qk - h * vk
        force += kl * (penetration(lower, width) - penetration(upper, width))
        implicit += h * h * (ks + kl * (gate(lower, width) + gate(upper, width)))
    store(sc.b, row.solve_dof + k, (
        h
        * (
            force
            - wp.dot(sw, load(sc.wrench_w, row.body + i))
            - wp.dot(sv, load(sc.wrench_v, row.body + i))
        )
        + wp.dot(sw, load(sc.push_w, row.solve_body + i))
        + wp.dot(sv, load(sc.push_v, row.solve_body + i))
    ))
    last = load(m.depth, k) - 1
    for d in range(last):
        j = load(m.path, k * m.width + d)
        store(sc.H, row.matrix + k * m.width + d, wp.dot(load(sc.axis_w, row.dof + j), angular) + wp.dot(
            load(sc.axis_v, row.dof + j), linear
        ))
    store(sc.H, row.matrix + k * m.width + last, (
        wp.dot(sw, angular) + wp.dot(sv, linear) + constant(m.armature, k) + implicit
    ))
