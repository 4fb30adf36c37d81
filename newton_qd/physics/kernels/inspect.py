"""Kernels that show a system from inside: poses, twists, mass matrix, bias forces.

Inputs: q and v of each world. Outputs: for each body pose (7) and twist (6, angular
first), both about O; or the mass matrix, row by row, and the bias forces.
"""

import warp as wp

from . import real, sync, transform, vec3
from .inertia import rigid_inertia
from .memory import constant, load, store
from .simulate import kinematics
from .structs import Model, Row, Scratch, row_at


@wp.func
def load_views(
    m: Model,
    sc: Scratch,
    g: Scratch,
    row: Row,
    x: wp.array[real],
    x_bar: wp.array[real],
    w: int,
):
    """Copy coordinates and velocities of world ``w`` into its slot."""
    at = w * (m.nq + m.nv)
    for k in range(m.nq):
        store(sc.q, row.q + k, constant(x, at + k))
    for k in range(m.nv):
        store(sc.v, row.v + k, constant(x, at + m.nq + k))


@wp.func_grad(load_views)
def adj_load_views(
    m: Model,
    sc: Scratch,
    g: Scratch,
    row: Row,
    x: wp.array[real],
    x_bar: wp.array[real],
    w: int,
):
    """Hand the adjoints of coordinates and velocities to the caller."""
    at = w * (m.nq + m.nv)
    for k in range(m.nq):
        store(x_bar, at + k, load(g.q, row.q + k))
        store(g.q, row.q + k, real(0.0))
    for k in range(m.nv):
        store(x_bar, at + m.nq + k, load(g.v, row.v + k))
        store(g.v, row.v + k, real(0.0))


@wp.func
def run_kinematics(m: Model, sc: Scratch, row: Row):
    """Kinematics of substep 0 with one lane; replayed by the adjoint kernel."""
    kinematics(m, sc, row, 0, 1)


@wp.func
def store_poses(m: Model, sc: Scratch, row: Row, y: wp.array[real], w: int):
    """Write poses and twists of world ``w``."""
    for i in range(m.nb):
        at = (w * m.nb + i) * 13
        for j in range(7):
            store(y, at + j, load(sc.pose, row.body + i + 1)[j])
        for j in range(3):
            store(y, at + 7 + j, load(sc.twist_w, row.body + i + 1)[j])
            store(y, at + 10 + j, load(sc.twist_v, row.body + i + 1)[j])


@wp.func
def seed_poses(m: Model, g: Scratch, row: Row, y_bar: wp.array[real], w: int):
    """Start the reverse pass with the caller's adjoints of poses and twists."""
    for i in range(m.nb):
        at = (w * m.nb + i) * 13
        p = transform()
        for j in range(7):
            p[j] = constant(y_bar, at + j)
        store(g.pose, row.body + i + 1, p)
        angular = vec3()
        linear = vec3()
        for j in range(3):
            angular[j] = constant(y_bar, at + 7 + j)
            linear[j] = constant(y_bar, at + 10 + j)
        store(g.twist_w, row.body + i + 1, angular)
        store(g.twist_v, row.body + i + 1, linear)


@wp.func_grad(seed_poses)
def adj_seed_poses(m: Model, g: Scratch, row: Row, y_bar: wp.array[real], w: int):
    """Nothing: seeding is not part of the kinematics."""
    sync(0)


@wp.func
def composite(m: Model, sc: Scratch, row: Row, i: int):
    """Rigid inertia and bias wrench of body ``i`` and its descendants."""
    at = row.solve_body + i
    body = row.body + i
    ww = load(sc.inertia, body)
    wv = wp.skew(load(sc.moment, body))
    vv = constant(m.mass, i) * wp.identity(n=3, dtype=real)
    n = load(sc.wrench_w, body)
    f = load(sc.wrench_v, body)
    for j in range(load(m.child_start, i), load(m.child_start, i + 1)):
        child = row.solve_body + load(m.child, j)
        ww += load(sc.total_ww, child)
        wv += load(sc.total_wv, child)
        vv += load(sc.total_vv, child)
        n += load(sc.total_w, child)
        f += load(sc.total_v, child)
    store(sc.total_ww, at, ww)
    store(sc.total_wv, at, wv)
    store(sc.total_vv, at, vv)
    store(sc.total_w, at, n)
    store(sc.total_v, at, f)


@wp.func
def dof_count(m: Model, i: int):
    """Degrees of freedom of joint ``i``."""
    count = int(1)
    if load(m.joint_kind, i) == 0:
        count = 6
    return count


@wp.func
def dof_axis(m: Model, sc: Scratch, row: Row, i: int, a: int):
    """Motion (angular, linear) about O of unit velocity of joint ``i``'s dof ``a``."""
    w = vec3()
    v = vec3()
    if load(m.joint_kind, i) == 0:
        if a < 3:
            v[a] = real(1.0)
        else:
            w[a - 3] = real(1.0)
            v = wp.cross(wp.transform_get_translation(load(sc.pose, row.body + i)), w)
    else:
        w = load(sc.axis_w, row.dof + load(m.v_start, i))
        v = load(sc.axis_v, row.dof + load(m.v_start, i))
    return w, v


@wp.func
def store_body(m: Model, sc: Scratch, row: Row, y: wp.array[real], out: int, i: int):
    """Rows of joint ``i``: M_kj = S_j . I_c S_k (Featherstone 2008, table 6.2)."""
    at = row.solve_body + i
    ww = load(sc.total_ww, at)
    wv = load(sc.total_wv, at)
    vv = load(sc.total_vv, at)
    for a in range(dof_count(m, i)):
        k = load(m.v_start, i) + a
        sw, sv = dof_axis(m, sc, row, i, a)
        bias = wp.dot(sw, load(sc.total_w, at)) + wp.dot(sv, load(sc.total_v, at))
        store(y, out + m.nv * m.nv + k, bias)
        angular = ww * sw + wv * sv
        linear = wp.transpose(wv) * sw + vv * sv
        up = int(i)
        while up > 0:
            for b in range(dof_count(m, up)):
                tw, tv = dof_axis(m, sc, row, up, b)
                j = load(m.v_start, up) + b
                value = wp.dot(tw, angular) + wp.dot(tv, linear)
                if j == k:
                    value += constant(m.armature, k)
                store(y, out + k * m.nv + j, value)
                store(y, out + j * m.nv + k, value)
            up = load(m.body_parent, up)


@wp.func
def store_dynamics(m: Model, sc: Scratch, row: Row, y: wp.array[real], w: int):
    """Write the mass matrix and the bias forces of world ``w``."""
    for i in range(1, m.nb + 1):
        rigid_inertia(m, sc, row, i)
    # children come after their parents
    for n in range(m.nb):
        composite(m, sc, row, m.nb - n)
    out = w * m.nv * (m.nv + 1)
    for k in range(m.nv * m.nv):
        store(y, out + k, real(0.0))
    for i in range(1, m.nb + 1):
        store_body(m, sc, row, y, out, i)


@wp.kernel(enable_backward=False)
def dynamics_forward(
    m: Model,
    first: int,
    slot_stride: int,
    lanes: int,
    sc: Scratch,
    x: wp.array[real],
    y: wp.array[real],
):
    """Mass matrix and bias forces."""
    n = wp.tid()
    w = first + n
    slot = n * slot_stride
    row = row_at(m, slot, 0, 0, 0)
    load_views(m, sc, sc, row, x, x, w)
    kinematics(m, sc, row, 0, 1)
    store_dynamics(m, sc, row, y, w)


@wp.kernel(enable_backward=False)
def kinematics_forward(
    m: Model,
    first: int,
    slot_stride: int,
    lanes: int,
    sc: Scratch,
    x: wp.array[real],
    y: wp.array[real],
):
    """Poses and twists."""
    n = wp.tid()
    w = first + n
    slot = n * slot_stride
    row = row_at(m, slot, 0, 0, 0)
    load_views(m, sc, sc, row, x, x, w)
    kinematics(m, sc, row, 0, 1)
    store_poses(m, sc, row, y, w)


@wp.kernel
def kinematics_backward(
    m: Model,
    first: int,
    slot_stride: int,
    lanes: int,
    sc: Scratch,
    g: Scratch,
    x: wp.array[real],
    y_bar: wp.array[real],
    x_bar: wp.array[real],
):
    """Adjoint of the kinematics; launched with ``adjoint=True``."""
    n = wp.tid()
    w = first + n
    slot = n * slot_stride
    row = row_at(m, slot, 1, 0, 0)
    load_views(m, sc, g, row, x, x_bar, w)
    run_kinematics(m, sc, row)
    seed_poses(m, g, row, y_bar, w)
