"""What a joint adds to a linear solve: its impulse, and what is implicit in it.

Springs, damping and limits of a joint are implicit in its new velocity. They sit on the
diagonal of the tree's equations. Controls are forces over the substep.
"""

import warp as wp

from newton_qd.physics.kinds import JointKind

from . import real, scalar, stage, sync
from .cpp.memory import constant, load, store
from .cpp.numbers import uniform
from .cpp.operators import add, mul, neg, sub  # noqa: F401
from .cpp.smooth import gate, penetration
from .parameters import joint_damping
from .structs import Model, Offsets, Scratch

# Hunt-Crossley factors switch over this fraction of their natural scale.
DISSIPATION_WIDTH = wp.constant(scalar(0.25))


@wp.func
def limit_law(m: Model, offsets: Offsets, k: int, q: real, rate: real):
    """Force of the limits of dof ``k`` at the end of a substep, and its slope over h.

    The force is that of the coordinate ``q`` and the velocity ``rate`` then.

    Reads: m.h, m.limit_lower, m.limit_upper, m.limit_stiffness, m.limit_smoothing,
        m.limit_dissipation.
    """
    kl = constant(m.limit_stiffness, k)
    width = uniform(m.limit_smoothing)
    lower = q - constant(m.limit_lower, k)
    upper = constant(m.limit_upper, k) - q
    depth_lower = kl * penetration(lower, width)
    depth_upper = kl * penetration(upper, width)
    force = depth_lower - depth_upper
    weight = m.h * kl * (gate(lower, width) + gate(upper, width))
    if m.limit_dissipation > scalar(0.0):
        # Hunt and Crossley's factor: a limit gives back less than it takes
        away = m.limit_dissipation * rate
        inward = neg(away) - scalar(1.0)
        away = away - scalar(1.0)
        brake = uniform(DISSIPATION_WIDTH)
        damper_lower = penetration(away, brake)
        damper_upper = penetration(inward, brake)
        force = depth_lower * damper_lower - depth_upper * damper_upper
        weight = m.h * kl * (
            damper_lower * gate(lower, width) + damper_upper * gate(upper, width)
        ) + m.limit_dissipation * (
            depth_lower * gate(away, brake) + depth_upper * gate(inward, brake)
        )
    return force, weight


@stage
def axis_law(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Impulse on the dof of joint ``i`` at its old velocity, and its diagonal.

    Reads: m.h, m.q_start, m.v_start, m.dof_control, m.gear, m.armature, m.stiffness,
        m.spring_rest, sc.q, sc.v, sc.ctrl, sc.parameter, sc.dv.
    Writes: sc.joint_push, sc.joint_weight.
    """
    k = load(m.v_start, i)
    h = m.h
    qk = load(sc.q, offsets.q + load(m.q_start, i))
    vk = load(sc.v, offsets.v + k)
    # limits are linearised about the velocity that the solve before found
    change = real()
    if offsets.corrects > 0:
        change = load(sc.dv, offsets.before_dof + k)
    rate = vk + change
    limits, weight = limit_law(m, offsets, k, qk + h * rate, rate)
    ks = constant(m.stiffness, k)
    kd = joint_damping(m, sc, offsets, k)
    force = (
        limits
        + weight * change
        - ks * (qk + h * vk - constant(m.spring_rest, k))
        - kd * vk
    )
    u = load(m.dof_control, k)
    if u >= 0:
        force = force + constant(m.gear, k) * load(sc.ctrl, offsets.ctrl + u)
    implicit = h * (weight + kd + h * ks)
    store(sc.joint_push, offsets.solve_dof + k, h * force)
    store(sc.joint_weight, offsets.solve_dof + k, constant(m.armature, k) + implicit)


@stage
def free_law(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Impulses on the dofs of a free joint; none unless they are driven.

    Reads: m.h, m.v_start, m.dof_control, m.gear, sc.ctrl.
    Writes: sc.joint_push.
    """
    k = load(m.v_start, i)
    for j in range(6):
        force = real()
        u = load(m.dof_control, k + j)
        if u >= 0:
            force = constant(m.gear, k + j) * load(sc.ctrl, offsets.ctrl + u)
        store(sc.joint_push, offsets.solve_dof + k + j, m.h * force)


@stage
def joint_laws(m: Model, sc: Scratch, offsets: Offsets, lane: int, lanes: int):
    """The laws of all joints.

    Reads: m.nb, m.joint_kind.
    """
    # lanes with one more contact have no more joints
    for i in range(lanes - lane, m.nb + 1, lanes):
        if load(m.joint_kind, i) == JointKind.FREE:
            free_law(m, sc, offsets, i)
        else:
            axis_law(m, sc, offsets, i)
    sync(lane)
