"""Kernels that show a system from inside: poses, twists, mass matrix, bias forces."""

import warp as wp

from . import real, sync, transform, vec3
from .dynamics import rigid_momentum
from .simulate import composite, kinematics
from .memory import constant, load, store
from .structs import Model, Row, Scratch, row_at


@wp.struct
class Views:
    """What the kernels report, or its adjoints; first index: world."""

    q: wp.array2d[real]
    v: wp.array2d[real]
    pose: wp.array3d[real]  # (world, body, 7) about O
    twist: wp.array3d[real]  # (world, body, 6) angular, then linear at O
    mass_matrix: wp.array3d[real]  # (world, dof, dof)
    bias: wp.array2d[real]  # (world, dof)


@wp.func
def load_views(
    m: Model, sc: Scratch, g: Scratch, row: Row, x: Views, x_bar: Views, w: int
):
    """Copy coordinates and velocities of world ``w`` into its slot."""
    for k in range(m.nq):
        store(sc.q, row.q + k, x.q[w, k])
    for k in range(m.nv):
        store(sc.v, row.v + k, x.v[w, k])


@wp.func_grad(load_views)
def adj_load_views(
    m: Model, sc: Scratch, g: Scratch, row: Row, x: Views, x_bar: Views, w: int
):
    """Hand the adjoints of coordinates and velocities to the caller."""
    for k in range(m.nq):
        x_bar.q[w, k] = load(g.q, row.q + k)
        store(g.q, row.q + k, real(0.0))
    for k in range(m.nv):
        x_bar.v[w, k] = load(g.v, row.v + k)
        store(g.v, row.v + k, real(0.0))


@wp.func
def run_kinematics(m: Model, sc: Scratch, row: Row):
    """Kinematics of substep 0 with one lane; replayed by the adjoint kernel."""
    kinematics(m, sc, row, 0, 1)


@wp.func
def store_poses(m: Model, sc: Scratch, row: Row, x: Views, w: int):
    """Write poses and twists of world ``w``."""
    for i in range(m.nb):
        for j in range(7):
            x.pose[w, i, j] = load(sc.pose, row.body + i + 1)[j]
        for j in range(3):
            x.twist[w, i, j] = load(sc.twist_w, row.body + i + 1)[j]
            x.twist[w, i, 3 + j] = load(sc.twist_v, row.body + i + 1)[j]


@wp.func
def seed_poses(m: Model, g: Scratch, row: Row, x_bar: Views, w: int):
    """Start the reverse pass with the caller's adjoints of poses and twists."""
    for i in range(m.nb):
        p = transform()
        for j in range(7):
            p[j] = x_bar.pose[w, i, j]
        store(g.pose, row.body + i + 1, p)
        angular = vec3()
        linear = vec3()
        for j in range(3):
            angular[j] = x_bar.twist[w, i, j]
            linear[j] = x_bar.twist[w, i, 3 + j]
        store(g.twist_w, row.body + i + 1, angular)
        store(g.twist_v, row.body + i + 1, linear)


@wp.func_grad(seed_poses)
def adj_seed_poses(m: Model, g: Scratch, row: Row, x_bar: Views, w: int):
    """Nothing: seeding is not part of the kinematics."""
    sync()


@wp.func
def store_dynamics(m: Model, sc: Scratch, row: Row, x: Views, w: int):
    """Write the mass matrix and the bias forces of world ``w``."""
    composite(m, sc, row, 0, 1)
    for k in range(m.nv):
        i = load(m.dof_body, k)
        sw = load(sc.axis_w, row.dof + k)
        sv = load(sc.axis_v, row.dof + k)
        angular, linear = rigid_momentum(m, sc, row, i, sw, sv)
        x.bias[w, k] = wp.dot(sw, load(sc.wrench_w, row.body + i)) + wp.dot(
            sv, load(sc.wrench_v, row.body + i)
        )
        for j in range(m.nv):
            x.mass_matrix[w, k, j] = real(0.0)
        for d in range(load(m.depth, k)):
            j = load(m.path, k * m.width + d)
            value = wp.dot(load(sc.axis_w, row.dof + j), angular) + wp.dot(
                load(sc.axis_v, row.dof + j), linear
            )
            if j == k:
                value += constant(m.armature, k)
            x.mass_matrix[w, k, j] = value


@wp.kernel(enable_backward=False)
def dynamics_forward(m: Model, first: int, slot_first: int, slot_stride: int, sc: Scratch, x: Views):
    """Lower triangle of the mass matrix along the tree, and bias forces."""
    n = wp.tid()
    w = first + n
    slot = slot_first + n * slot_stride
    row = row_at(m, slot, 0, 0, 0)
    load_views(m, sc, sc, row, x, x, w)
    kinematics(m, sc, row, 0, 1)
    store_dynamics(m, sc, row, x, w)


@wp.kernel(enable_backward=False)
def kinematics_forward(m: Model, first: int, slot_first: int, slot_stride: int, sc: Scratch, x: Views):
    """Poses and twists."""
    n = wp.tid()
    w = first + n
    slot = slot_first + n * slot_stride
    row = row_at(m, slot, 0, 0, 0)
    load_views(m, sc, sc, row, x, x, w)
    kinematics(m, sc, row, 0, 1)
    store_poses(m, sc, row, x, w)


@wp.kernel
def kinematics_backward(
    m: Model,
    first: int,
    slot_first: int,
    slot_stride: int,
    sc: Scratch,
    g: Scratch,
    x: Views,
    x_bar: Views,
):
    """Adjoint of the kinematics; launched with ``adjoint=True``."""
    n = wp.tid()
    w = first + n
    slot = slot_first + n * slot_stride
    row = row_at(m, slot, 1, 0, 0)
    load_views(m, sc, g, row, x, x_bar, w)
    run_kinematics(m, sc, row)
    seed_poses(m, g, row, x_bar, w)
