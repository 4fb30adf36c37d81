"""Poses, motion subspaces, twists and bias accelerations, root to leaves.

Spatial vectors are (angular, linear) in world axes about the origin O, the position
of a free root (Featherstone 2008, ch. 2 and 5). Gravity enters as an upward
acceleration of the world.
"""

import warp as wp

from . import quat, real, stage, transform, vec3
from .memory import constant, load, store
from .structs import Model, Row, Scratch


@stage
def world_frame(m: Model, sc: Scratch, row: Row):
    """Pose of the world frame seen from O."""
    p = vec3()
    if m.free_root == 1:
        p = -vec3(load(sc.q, row.q), load(sc.q, row.q + 1), load(sc.q, row.q + 2))
    zero = vec3()
    store(
        sc.pose,
        row.body,
        transform(p, quat(real(0.0), real(0.0), real(0.0), real(1.0))),
    )
    store(sc.twist_w, row.body, zero)
    store(sc.twist_v, row.body, zero)
    store(sc.bias_w, row.body, zero)
    store(sc.bias_v, row.body, vec3(real(0.0), real(0.0), m.gravity))


@stage
def free_joint(m: Model, sc: Scratch, row: Row, i: int):
    """Six dofs: velocity of the body origin, then angular velocity, world axes."""
    a = load(m.q_start, i)
    k = load(m.v_start, i)
    p = vec3(
        load(sc.q, row.q + a), load(sc.q, row.q + a + 1), load(sc.q, row.q + a + 2)
    )
    r = quat(
        load(sc.q, row.q + a + 3),
        load(sc.q, row.q + a + 4),
        load(sc.q, row.q + a + 5),
        load(sc.q, row.q + a + 6),
    )
    x = load(sc.pose, row.body + load(m.body_parent, i)) * transform(p, r)
    store(sc.pose, row.body + i, x)
    at = wp.transform_get_translation(x)
    vl = vec3(
        load(sc.v, row.v + k), load(sc.v, row.v + k + 1), load(sc.v, row.v + k + 2)
    )
    om = vec3(
        load(sc.v, row.v + k + 3), load(sc.v, row.v + k + 4), load(sc.v, row.v + k + 5)
    )
    store(sc.twist_w, row.body + i, om)
    store(sc.twist_v, row.body + i, vl + wp.cross(at, om))
    store(sc.bias_w, row.body + i, vec3())
    # d/dt (at x om) at constant coordinates, plus the world's acceleration
    store(sc.bias_v, row.body + i, load(sc.bias_v, row.body) + wp.cross(vl, om))


@stage
def hinge_joint(m: Model, sc: Scratch, row: Row, i: int):
    """One revolute or prismatic dof about a fixed axis of the joint frame."""
    p = load(m.body_parent, i)
    k = load(m.v_start, i)
    qk = load(sc.q, row.q + load(m.q_start, i))
    vk = load(sc.v, row.v + k)
    frame = load(sc.pose, row.body + p) * constant(m.parent_frame, i)
    axis = constant(m.joint_axis, i)
    a = wp.quat_rotate(wp.transform_get_rotation(frame), axis)
    angle = qk
    shift = real(0.0)
    sw = a
    sv = wp.cross(wp.transform_get_translation(frame), a)
    if load(m.joint_kind, i) == 2:
        angle = real(0.0)
        shift = qk
        sw = vec3()
        sv = a
    turn = wp.quat_from_axis_angle(axis, angle)
    # a is the joint's axis in world axes: a slide moves along it
    x = transform(
        wp.transform_get_translation(frame) + shift * a,
        wp.transform_get_rotation(frame) * turn,
    )
    if load(m.child_moved, i) == 1:
        x = x * constant(m.child_frame_inverse, i)
    store(sc.pose, row.body + i, x)
    store(sc.axis_w, row.dof + k, sw)
    store(sc.axis_v, row.dof + k, sv)
    vw = load(sc.twist_w, row.body + p) + sw * vk
    vv = load(sc.twist_v, row.body + p) + sv * vk
    store(sc.twist_w, row.body + i, vw)
    store(sc.twist_v, row.body + i, vv)
    store(
        sc.bias_w, row.body + i, load(sc.bias_w, row.body + p) + wp.cross(vw, sw) * vk
    )
    store(
        sc.bias_v,
        row.body + i,
        load(sc.bias_v, row.body + p) + (wp.cross(vw, sv) + wp.cross(vv, sw)) * vk,
    )
