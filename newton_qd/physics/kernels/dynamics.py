"""The kernel that shows the mass matrix and the bias forces.

Inputs and outputs are rows as in :mod:`.rows`: ``Coordinates`` and ``Dynamics``.
"""

import warp as wp

from newton_qd.physics.kinds import JointKind

from . import real, scalar, sym33, vec3
from .coordinates import load_coordinates
from .cpp.algebra import add_diagonal, cross, dot, skew, translation, vector
from .cpp.memory import constant, load, store, write_output
from .cpp.numbers import uniform
from .cpp.operators import add, mul  # noqa: F401
from .cpp.place import place
from .inertia import bias_wrench, rigid_inertia
from .kinematics import kinematics
from .structs import Model, Offsets, Scratch, offsets_at
from .world import Pack, pack_at


@wp.func
def composite(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Rigid inertia and bias wrench of body ``i`` and its descendants.

    Reads: m.mass, m.child_start, m.child, sc.inertia, sc.moment, sc.wrench_w,
        sc.wrench_v, sc.passed_ww, sc.passed_wv, sc.passed_vv, sc.passed_w, sc.passed_v.
    Writes: sc.passed_ww, sc.passed_wv, sc.passed_vv, sc.passed_w, sc.passed_v.
    """
    at = offsets.reading + i
    body = offsets.body + i
    ww = load(sc.inertia, body)
    wv = skew(load(sc.moment, body))
    vv = add_diagonal(sym33(), constant(m.mass, i))
    n = load(sc.wrench_w, offsets.motion + i)
    f = load(sc.wrench_v, offsets.motion + i)
    for j in range(load(m.child_start, i), load(m.child_start, i + 1)):
        child = offsets.reading + load(m.child, j)
        ww = ww + load(sc.passed_ww, child)
        wv = wv + load(sc.passed_wv, child)
        vv = vv + load(sc.passed_vv, child)
        n = n + load(sc.passed_w, child)
        f = f + load(sc.passed_v, child)
    store(sc.passed_ww, at, ww)
    store(sc.passed_wv, at, wv)
    store(sc.passed_vv, at, vv)
    store(sc.passed_w, at, n)
    store(sc.passed_v, at, f)


@wp.func
def dof_count(m: Model, i: int):
    """Degrees of freedom of joint ``i``.

    Reads: m.joint_kind.
    """
    count = int(1)
    if load(m.joint_kind, i) == JointKind.FREE:
        count = 6
    return count


@wp.func
def dof_axis(m: Model, sc: Scratch, offsets: Offsets, i: int, a: int):
    """Motion (angular, linear) about O of unit velocity of joint ``i``'s dof ``a``.

    Reads: m.joint_kind, m.v_start, sc.pose, sc.axis_w, sc.axis_v.
    """
    w = vec3()
    v = vec3()
    if load(m.joint_kind, i) == JointKind.FREE:
        unit = vector(
            uniform(scalar(a % 3 == 0)),
            uniform(scalar(a % 3 == 1)),
            uniform(scalar(a % 3 == 2)),
        )
        if a < 3:
            v = unit
        else:
            w = unit
            v = cross(translation(load(sc.pose, offsets.body + i)), unit)
    else:
        w = load(sc.axis_w, offsets.dof + load(m.v_start, i))
        v = load(sc.axis_v, offsets.dof + load(m.v_start, i))
    return w, v


@wp.func
def store_body(
    m: Model, sc: Scratch, offsets: Offsets, y: wp.array[scalar], pack: Pack, i: int
):
    """Rows of joint ``i``: M_kj = S_j . I_c S_k (Featherstone 2008, table 6.2).

    Reads: m.nv, m.body_parent, m.v_start, m.armature, m.dynamics, sc.pose,
        sc.axis_w, sc.axis_v, sc.passed_ww, sc.passed_wv, sc.passed_vv, sc.passed_w,
        sc.passed_v.
    Writes: y.
    """
    size = m.dynamics.size
    matrix = pack.first * size + m.dynamics.mass_matrix
    forces = pack.first * size + m.dynamics.bias
    at = offsets.reading + i
    ww = load(sc.passed_ww, at)
    wv = load(sc.passed_wv, at)
    vv = load(sc.passed_vv, at)
    for a in range(dof_count(m, i)):
        k = load(m.v_start, i) + a
        sw, sv = dof_axis(m, sc, offsets, i, a)
        bias = dot(sw, load(sc.passed_w, at)) + dot(sv, load(sc.passed_v, at))
        write_output(y, forces + k, size, pack.count, bias)
        angular = ww * sw + wv * sv
        linear = sw * wv + vv * sv
        up = int(i)
        while up > 0:
            for b in range(dof_count(m, up)):
                tw, tv = dof_axis(m, sc, offsets, up, b)
                j = load(m.v_start, up) + b
                value = dot(tw, angular) + dot(tv, linear)
                if j == k:
                    value = value + constant(m.armature, k)
                write_output(y, matrix + k * m.nv + j, size, pack.count, value)
                write_output(y, matrix + j * m.nv + k, size, pack.count, value)
            up = load(m.body_parent, up)


@wp.func
def store_dynamics(
    m: Model, sc: Scratch, offsets: Offsets, y: wp.array[scalar], pack: Pack
):
    """Write the mass matrix and the bias forces of a pack.

    Reads: m.nb, m.nv, m.dynamics, sc.pose, sc.inertia, sc.moment, sc.wrench_w,
        sc.wrench_v, sc.axis_w, sc.axis_v, sc.passed_ww, sc.passed_wv, sc.passed_vv,
        sc.passed_w, sc.passed_v.
    Writes: sc.passed_ww, sc.passed_wv, sc.passed_vv, sc.passed_w, sc.passed_v, y.
    """
    for i in range(1, m.nb + 1):
        rigid_inertia(m, sc, offsets, i)
        bias_wrench(m, sc, offsets, i)
    # children come after their parents
    for n in range(m.nb):
        composite(m, sc, offsets, m.nb - n)
    size = m.dynamics.size
    matrix = pack.first * size + m.dynamics.mass_matrix
    for k in range(m.nv * m.nv):
        write_output(y, matrix + k, size, pack.count, real())
    for i in range(1, m.nb + 1):
        store_body(m, sc, offsets, y, pack, i)


@wp.kernel(enable_backward=False)
def dynamics_forward(
    m: Model,
    first: int,
    slot_stride: int,
    worlds: int,
    lanes: int,
    scratch: Scratch,
    x: wp.array[scalar],
    y: wp.array[scalar],
):
    """Mass matrix and bias forces.

    Reads: x.
    Writes: y.
    """
    pack = pack_at(wp.tid(), first, worlds, slot_stride, 1)
    sc = place(scratch, pack.column)
    offsets = offsets_at(m, pack.slot, 0, 0, 0)
    load_coordinates(m, sc, sc, offsets, x, x, pack)
    kinematics(m, sc, offsets, 0, 0, 1)
    store_dynamics(m, sc, offsets, y, pack)
