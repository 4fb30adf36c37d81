"""Poses, motion subspaces, twists and bias accelerations, root to leaves.

Spatial vectors are (angular, linear) in world axes about the origin O, the position
of a free root (Featherstone 2008, ch. 2 and 5). Gravity enters as an upward
acceleration of the world.
"""

import warp as wp

from . import quat, real, stage, transform, vec3
from .structs import Model, Scratch


@stage
def world_frame(m: Model, sc: Scratch, slot: int, s: int):
    """Pose of the world frame seen from O."""
    p = vec3()
    if m.free_root == 1:
        p = -vec3(sc.q[slot, s, 0], sc.q[slot, s, 1], sc.q[slot, s, 2])
    zero = vec3()
    sc.pose[slot, s, 0] = transform(p, quat(real(0.0), real(0.0), real(0.0), real(1.0)))
    sc.twist_w[slot, s, 0] = zero
    sc.twist_v[slot, s, 0] = zero
    sc.bias_w[slot, s, 0] = zero
    sc.bias_v[slot, s, 0] = vec3(real(0.0), real(0.0), m.gravity)


@wp.func
def unit(a: int):
    """Unit vector of a world axis."""
    return vec3(real(int(a == 0)), real(int(a == 1)), real(int(a == 2)))


@stage
def free_joint(m: Model, sc: Scratch, slot: int, s: int, i: int):
    """Six dofs: velocity of the body origin, then angular velocity, world axes."""
    a = m.q_start[i]
    k = m.v_start[i]
    p = vec3(sc.q[slot, s, a], sc.q[slot, s, a + 1], sc.q[slot, s, a + 2])
    r = quat(
        sc.q[slot, s, a + 3],
        sc.q[slot, s, a + 4],
        sc.q[slot, s, a + 5],
        sc.q[slot, s, a + 6],
    )
    x = sc.pose[slot, s, m.body_parent[i]] * transform(p, r)
    sc.pose[slot, s, i] = x
    at = wp.transform_get_translation(x)
    vl = vec3(sc.v[slot, s, k], sc.v[slot, s, k + 1], sc.v[slot, s, k + 2])
    om = vec3(sc.v[slot, s, k + 3], sc.v[slot, s, k + 4], sc.v[slot, s, k + 5])
    for j in range(3):
        e = unit(j)
        sc.axis_w[slot, s, k + j] = vec3()
        sc.axis_v[slot, s, k + j] = e
        sc.axis_w[slot, s, k + 3 + j] = e
        sc.axis_v[slot, s, k + 3 + j] = wp.cross(at, e)
    sc.twist_w[slot, s, i] = om
    sc.twist_v[slot, s, i] = vl + wp.cross(at, om)
    sc.bias_w[slot, s, i] = vec3()
    # d/dt (at x om) at constant coordinates, plus the world's acceleration
    sc.bias_v[slot, s, i] = sc.bias_v[slot, s, 0] + wp.cross(vl, om)


@stage
def hinge_joint(m: Model, sc: Scratch, slot: int, s: int, i: int):
    """One revolute or prismatic dof about a fixed axis of the joint frame."""
    p = m.body_parent[i]
    k = m.v_start[i]
    qk = sc.q[slot, s, m.q_start[i]]
    vk = sc.v[slot, s, k]
    frame = sc.pose[slot, s, p] * m.parent_frame[i]
    axis = m.joint_axis[i]
    a = wp.quat_rotate(wp.transform_get_rotation(frame), axis)
    angle = qk
    shift = real(0.0)
    sw = a
    sv = wp.cross(wp.transform_get_translation(frame), a)
    if m.joint_kind[i] == 2:
        angle = real(0.0)
        shift = qk
        sw = vec3()
        sv = a
    motion = transform(shift * axis, wp.quat_from_axis_angle(axis, angle))
    sc.pose[slot, s, i] = frame * motion * m.child_frame_inverse[i]
    sc.axis_w[slot, s, k] = sw
    sc.axis_v[slot, s, k] = sv
    vw = sc.twist_w[slot, s, p] + sw * vk
    vv = sc.twist_v[slot, s, p] + sv * vk
    sc.twist_w[slot, s, i] = vw
    sc.twist_v[slot, s, i] = vv
    sc.bias_w[slot, s, i] = sc.bias_w[slot, s, p] + wp.cross(vw, sw) * vk
    sc.bias_v[slot, s, i] = (
        sc.bias_v[slot, s, p] + (wp.cross(vw, sv) + wp.cross(vv, sw)) * vk
    )
