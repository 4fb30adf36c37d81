"""Poses and axes, then twists and bias accelerations, root to leaves.

Spatial vectors are (angular, linear) in world axes about the origin O (Featherstone
2008, ch. 2 and 5), which is where a free root or the slides under a root have moved:
near the robot wherever it goes, because inertias about a far point have no digits left.
Gravity enters as an upward acceleration of the world.
"""

import warp as wp

from newton_qd.physics.kinds import JointKind

from . import real, scalar, stage, sync, vec3
from .cpp.algebra import cross, quaternion, rigid, rotate, rotation, translation, vector
from .cpp.memory import constant, load, store
from .cpp.numbers import uniform
from .cpp.operators import add, mul, neg  # noqa: F401
from .cpp.smooth import turn_about
from .parameters import gravity
from .structs import Model, Offsets, Scratch


@stage
def world_frame(m: Model, sc: Scratch, offsets: Offsets):
    """Pose of the world frame seen from O.

    Reads: m.nq, m.origin_axis, sc.q.
    Writes: sc.pose.
    """
    # a robot with fewer coordinates reads its last one again, times zero
    last = offsets.q + m.nq - 1
    first = load(sc.q, offsets.q) * constant(m.origin_axis, 0)
    second = load(sc.q, wp.min(offsets.q + 1, last)) * constant(m.origin_axis, 1)
    third = load(sc.q, wp.min(offsets.q + 2, last)) * constant(m.origin_axis, 2)
    p = neg(first + second + third)
    store(
        sc.pose,
        offsets.body,
        rigid(p, quaternion(real(), real(), real(), uniform(scalar(1.0)))),
    )


@stage
def world_motion(m: Model, sc: Scratch, offsets: Offsets):
    """The world rests, and accelerates upwards against gravity.

    Reads: sc.parameter.
    Writes: sc.twist_w, sc.twist_v, sc.bias_w, sc.bias_v.
    """
    zero = vec3()
    store(sc.twist_w, offsets.motion, zero)
    store(sc.twist_v, offsets.motion, zero)
    store(sc.bias_w, offsets.motion, zero)
    store(sc.bias_v, offsets.motion, vector(real(), real(), gravity(m, sc, offsets)))


@stage
def free_joint(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Six dofs: velocity of the body origin, then angular velocity, world axes.

    Reads: m.body_parent, m.q_start, sc.q, sc.pose.
    Writes: sc.pose.
    """
    a = load(m.q_start, i)
    p = vector(
        load(sc.q, offsets.q + a),
        load(sc.q, offsets.q + a + 1),
        load(sc.q, offsets.q + a + 2),
    )
    r = quaternion(
        load(sc.q, offsets.q + a + 3),
        load(sc.q, offsets.q + a + 4),
        load(sc.q, offsets.q + a + 5),
        load(sc.q, offsets.q + a + 6),
    )
    x = load(sc.pose, offsets.body + load(m.body_parent, i)) * rigid(p, r)
    store(sc.pose, offsets.body + i, x)


@stage
def free_motion(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Twist and bias acceleration of a free root.

    Reads: m.v_start, sc.v, sc.pose, sc.bias_v.
    Writes: sc.twist_w, sc.twist_v, sc.bias_w, sc.bias_v.
    """
    k = load(m.v_start, i)
    at = translation(load(sc.pose, offsets.body + i))
    at_v = offsets.v_body + k
    vl = vector(load(sc.v, at_v), load(sc.v, at_v + 1), load(sc.v, at_v + 2))
    om = vector(load(sc.v, at_v + 3), load(sc.v, at_v + 4), load(sc.v, at_v + 5))
    store(sc.twist_w, offsets.motion + i, om)
    store(sc.twist_v, offsets.motion + i, vl + cross(at, om))
    store(sc.bias_w, offsets.motion + i, vec3())
    # d/dt (at x om) at constant coordinates, plus the world's acceleration
    bias = load(sc.bias_v, offsets.motion) + cross(vl, om)
    store(sc.bias_v, offsets.motion + i, bias)


@stage
def axis_joint(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """One revolute or prismatic dof about a fixed axis of the joint frame.

    Reads: m.body_parent, m.joint_kind, m.q_start, m.v_start, m.joint_axis,
        m.parent_frame, m.child_frame_inverse, m.child_moved, sc.q, sc.pose.
    Writes: sc.pose, sc.axis_w, sc.axis_v.
    """
    p = load(m.body_parent, i)
    k = load(m.v_start, i)
    qk = load(sc.q, offsets.q + load(m.q_start, i))
    frame = load(sc.pose, offsets.body + p) * constant(m.parent_frame, i)
    axis = constant(m.joint_axis, i)
    a = rotate(rotation(frame), axis)
    angle = qk
    shift = real()
    sw = a
    sv = cross(translation(frame), a)
    if load(m.joint_kind, i) == JointKind.PRISMATIC:
        angle = real()
        shift = qk
        sw = vec3()
        sv = a
    turn = turn_about(axis, angle)
    # a is the joint's axis in world axes: a slide moves along it
    x = rigid(
        translation(frame) + shift * a,
        rotation(frame) * turn,
    )
    if load(m.child_moved, i) == 1:
        x = x * constant(m.child_frame_inverse, i)
    store(sc.pose, offsets.body + i, x)
    store(sc.axis_w, offsets.dof + k, sw)
    store(sc.axis_v, offsets.dof + k, sv)


@stage
def axis_motion(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Twist and bias acceleration of body ``i``, whose joint has one dof.

    Reads: m.body_parent, m.v_start, sc.v, sc.axis_w, sc.axis_v, sc.twist_w,
        sc.twist_v, sc.bias_w, sc.bias_v.
    Writes: sc.twist_w, sc.twist_v, sc.bias_w, sc.bias_v.
    """
    p = offsets.motion + load(m.body_parent, i)
    k = load(m.v_start, i)
    vk = load(sc.v, offsets.v_body + k)
    sw = load(sc.axis_w, offsets.dof + k)
    sv = load(sc.axis_v, offsets.dof + k)
    vw = load(sc.twist_w, p) + vk * sw
    vv = load(sc.twist_v, p) + vk * sv
    store(sc.twist_w, offsets.motion + i, vw)
    store(sc.twist_v, offsets.motion + i, vv)
    store(
        sc.bias_w,
        offsets.motion + i,
        load(sc.bias_w, p) + vk * cross(vw, sw),
    )
    store(
        sc.bias_v,
        offsets.motion + i,
        load(sc.bias_v, p) + vk * (cross(vw, sv) + cross(vv, sw)),
    )


@stage
def limb_kinematics(m: Model, sc: Scratch, offsets: Offsets, n: int, moved: int):
    """Poses and axes (unless ``moved`` is 1), twists and bias accelerations of a limb.

    Reads: m.joint_kind, m.limb_start, m.limb_body.
    """
    for p in range(load(m.limb_start, n), load(m.limb_start, n + 1)):
        i = load(m.limb_body, p)
        if load(m.joint_kind, i) == JointKind.FREE:
            if moved == 0:
                free_joint(m, sc, offsets, i)
            free_motion(m, sc, offsets, i)
        else:
            if moved == 0:
                axis_joint(m, sc, offsets, i)
            axis_motion(m, sc, offsets, i)


@stage
def kinematics(
    m: Model, sc: Scratch, offsets: Offsets, moved: int, lane: int, lanes: int
):
    """Poses and axes, then twists and bias accelerations, root to leaves.

    ``moved`` is 1 for twists and bias accelerations alone, at other velocities.

    Reads: m.levels, m.roots, m.limb_level.
    """
    if lane == 0:
        if moved == 0:
            world_frame(m, sc, offsets)
        world_motion(m, sc, offsets)
    # the lane of the world has the first root as well
    if m.roots > 1:
        sync(lane)
    for level in range(m.levels):
        first = load(m.limb_level, level) + lane
        for n in range(first, load(m.limb_level, level + 1), lanes):
            limb_kinematics(m, sc, offsets, n, moved)
        sync(lane)
