"""Kernels that show a system from inside: poses, twists, mass matrix, bias forces."""

import warp as wp

from . import real, sync, transform, vec3
from .dynamics import rigid_momentum
from .simulate import composite, kinematics
from .structs import Model, Scratch


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
    m: Model, sc: Scratch, g: Scratch, slot: int, x: Views, x_bar: Views, w: int
):
    """Copy coordinates and velocities of world ``w`` into its slot."""
    for k in range(m.nq):
        sc.q[slot, 0, k] = x.q[w, k]
    for k in range(m.nv):
        sc.v[slot, 0, k] = x.v[w, k]


@wp.func_grad(load_views)
def adj_load_views(
    m: Model, sc: Scratch, g: Scratch, slot: int, x: Views, x_bar: Views, w: int
):
    """Hand the adjoints of coordinates and velocities to the caller."""
    for k in range(m.nq):
        x_bar.q[w, k] = g.q[slot, 0, k]
        g.q[slot, 0, k] = real(0.0)
    for k in range(m.nv):
        x_bar.v[w, k] = g.v[slot, 0, k]
        g.v[slot, 0, k] = real(0.0)


@wp.func
def run_kinematics(m: Model, sc: Scratch, slot: int):
    """Kinematics of substep 0 with one lane; replayed by the adjoint kernel."""
    kinematics(m, sc, slot, 0, 0, 1)


@wp.func
def store_poses(m: Model, sc: Scratch, slot: int, x: Views, w: int):
    """Write poses and twists of world ``w``."""
    for i in range(m.nb):
        for j in range(7):
            x.pose[w, i, j] = sc.pose[slot, 0, i + 1][j]
        for j in range(3):
            x.twist[w, i, j] = sc.twist_w[slot, 0, i + 1][j]
            x.twist[w, i, 3 + j] = sc.twist_v[slot, 0, i + 1][j]


@wp.func
def seed_poses(m: Model, g: Scratch, slot: int, x_bar: Views, w: int):
    """Start the reverse pass with the caller's adjoints of poses and twists."""
    for i in range(m.nb):
        p = transform()
        for j in range(7):
            p[j] = x_bar.pose[w, i, j]
        g.pose[slot, 0, i + 1] = p
        g.twist_w[slot, 0, i + 1] = vec3(
            x_bar.twist[w, i, 0], x_bar.twist[w, i, 1], x_bar.twist[w, i, 2]
        )
        g.twist_v[slot, 0, i + 1] = vec3(
            x_bar.twist[w, i, 3], x_bar.twist[w, i, 4], x_bar.twist[w, i, 5]
        )


@wp.func_grad(seed_poses)
def adj_seed_poses(m: Model, g: Scratch, slot: int, x_bar: Views, w: int):
    """Nothing: seeding is not part of the kinematics."""
    sync()


@wp.func
def store_dynamics(m: Model, sc: Scratch, slot: int, x: Views, w: int):
    """Write the mass matrix and the bias forces of world ``w``."""
    composite(m, sc, slot, 0, 0, 1)
    for k in range(m.nv):
        i = m.dof_body[k]
        sw = sc.axis_w[slot, 0, k]
        sv = sc.axis_v[slot, 0, k]
        angular, linear = rigid_momentum(m, sc, slot, 0, i, sw, sv)
        x.bias[w, k] = wp.dot(sw, sc.wrench_w[slot, 0, i]) + wp.dot(
            sv, sc.wrench_v[slot, 0, i]
        )
        for j in range(m.nv):
            x.mass_matrix[w, k, j] = real(0.0)
        for d in range(m.depth[k]):
            j = m.path[k, d]
            value = wp.dot(sc.axis_w[slot, 0, j], angular) + wp.dot(
                sc.axis_v[slot, 0, j], linear
            )
            if j == k:
                value += m.armature[k]
            x.mass_matrix[w, k, j] = value


@wp.kernel(enable_backward=False)
def dynamics_forward(m: Model, first: int, slot_first: int, slot_stride: int, sc: Scratch, x: Views):
    """Lower triangle of the mass matrix along the tree, and bias forces."""
    n = wp.tid()
    w = first + n
    slot = slot_first + n * slot_stride
    load_views(m, sc, sc, slot, x, x, w)
    kinematics(m, sc, slot, 0, 0, 1)
    store_dynamics(m, sc, slot, x, w)


@wp.kernel(enable_backward=False)
def kinematics_forward(m: Model, first: int, slot_first: int, slot_stride: int, sc: Scratch, x: Views):
    """Poses and twists."""
    n = wp.tid()
    w = first + n
    slot = slot_first + n * slot_stride
    load_views(m, sc, sc, slot, x, x, w)
    kinematics(m, sc, slot, 0, 0, 1)
    store_poses(m, sc, slot, x, w)


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
    load_views(m, sc, g, slot, x, x_bar, w)
    run_kinematics(m, sc, slot)
    seed_poses(m, g, slot, x_bar, w)
