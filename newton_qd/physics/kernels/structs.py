"""Arrays that the kernels read (Model) and write (Scratch)."""

import warp as wp

from . import scalar
from .cpp.memory import (
    IntTable,
    Matrices,
    MatrixTable,
    Reals,
    RealTable,
    Symmetrics,
    Transforms,
    TransformTable,
    Vectors,
    VectorTable,
)
from .rows import Bodies, Coordinates, Dynamics, Inputs, Outputs, Parameters


@wp.struct
class Model:
    """One robot in one scene; shared by all worlds. Row 0 of a body table is the world.

    Bodies are counted from 1 in ``body_parent`` and in every scratch array.
    """

    nb: int
    nq: int
    nv: int
    nu: int
    nc: int
    pairs: int
    substeps: int
    total_mass: scalar  # [kg]
    iterations: int  # times that a substep finds the velocities of its bodies
    follows: scalar  # 1: the predictor's slope is also that of the dissipation factor
    given: int  # solve from which normal impulses are given
    friction_answers: scalar  # share of friction in those that answers the velocity
    solves: int  # solves of an iteration: predictor and correctors
    h: scalar  # [s]
    gravity: scalar  # [m/s^2]
    # the numbers and the integers of all tables
    numbers: wp.array[scalar]
    integers: wp.array[int]
    rest_q: RealTable  # (nq,)
    origin_axis: VectorTable  # (3,) what a coordinate adds to the origin O
    # bodies, (nb + 1)
    body_parent: IntTable
    joint_kind: IntTable
    q_start: IntTable
    v_start: IntTable
    joint_axis: VectorTable
    parent_frame: TransformTable
    child_frame_inverse: TransformTable
    child_moved: IntTable  # 0: the child frame is the identity
    mass: RealTable
    com: VectorTable
    inertia: MatrixTable
    isotropic: IntTable  # 1: the inertia does not depend on the rotation
    # limbs: runs of bodies with one child each
    levels: int
    roots: int  # limbs of the first level
    limb_level: IntTable  # (levels + 1,) first limb
    limb_start: IntTable  # (limbs + 1,)
    limb_body: IntTable  # (nb,) by limb, from root to tip
    child_start: IntTable
    child: IntTable
    # degrees of freedom, (nv)
    dof_control: IntTable  # index in ctrl, -1 if not driven
    gear: RealTable
    armature: RealTable
    damping: RealTable
    stiffness: RealTable
    spring_rest: RealTable
    limit_lower: RealTable
    limit_upper: RealTable
    limit_stiffness: RealTable
    limit_smoothing: scalar
    limit_dissipation: scalar  # [s/rad or s/m]
    # contacts, (nc)
    contact_start: IntTable  # (nb + 2)
    contact_stop: IntTable  # (nb + 1), where the body's rows of pairs begin
    contact_body: IntTable
    contact_position: VectorTable
    contact_segment: VectorTable
    contact_radius: RealTable
    contact_obstacle: IntTable
    contact_partner: IntTable  # row of the other side of a pair, else -1
    contact_lead: IntTable  # row of the side that a pair is measured from
    pair_lead: IntTable  # (pairs,)
    obstacle_kind: IntTable
    obstacle_frame: TransformTable
    obstacle_size: VectorTable
    contact_stiffness: scalar
    contact_smoothing: scalar
    friction: scalar
    slip_velocity: scalar
    dissipation: scalar
    # readings
    reports_bodies: int  # 1: a step reports where the bodies are
    torso: int  # body
    torso_q: int  # its first coordinate where it moves freely, else -1
    # feet, (nf)
    nf: int
    foot: IntTable  # body
    foot_weight: scalar  # impulse of the robot's weight over a control step [N s]
    foot_fraction: scalar  # share of it above which a foot touches the ground
    foot_width: scalar  # share of it over which the smooth contact rises
    foot_tail: int  # how its slope decays
    # rows of the caller's arrays
    inputs: Inputs
    outputs: Outputs
    reported: Bodies  # in the outputs of a step
    coordinates: Coordinates
    bodies: Bodies
    dynamics: Dynamics
    # rows of the scratch
    parameters: Parameters


@wp.struct
class Scratch:
    """Intermediates of one control step; also the layout of their adjoints.

    :mod:`.cpp.memory` says how they lie in the memory, and :class:`Offsets` where a
    substep's entries begin.
    """

    memory: wp.array[scalar]
    lines: int  # of a group of worlds, with adjoints

    q: Reals
    v: Reals
    ctrl: Reals
    parameter: Reals  # as Parameters says
    # (slots,), 0 or 1: the step failed; its inputs were not finite
    fault: Reals
    lost: Reals
    wrong: Reals  # contacts, without adjoint: an impulse is not finite
    # bodies; world axes, spatial vectors about O
    pose: Transforms
    twist_w: Vectors
    twist_v: Vectors
    bias_w: Vectors
    bias_v: Vectors
    inertia: Symmetrics
    moment: Vectors
    wrench_w: Vectors
    wrench_v: Vectors
    # bodies over the control step, and in the returned state in the world
    body_impulse: Vectors
    body_angular_impulse: Vectors
    body_normal_impulse: Reals
    position: Vectors
    com: Vectors
    com_velocity: Vectors
    # readings
    torso_xy: Reals  # (2 slots,)
    foot_contact: Reals
    smooth_foot_contact: Reals
    # degrees of freedom
    axis_w: Vectors
    axis_v: Vectors
    # contacts
    point: Vectors
    arm: Vectors
    normal: Vectors
    velocity: Vectors
    gap: Reals
    impulse: Vectors
    angular_impulse: Vectors
    normal_impulse: Reals
    # contacts, per solve: the law at the velocity expected, and linearised about it
    load: Reals
    push_n: Reals
    push: Vectors
    weight_n: Reals
    weight_t: Reals
    slip: Vectors
    # joints, per solve: impulse at the old velocity, and what resists the change
    joint_push: Reals
    joint_weight: Reals
    dv: Reals  # what a solve finds
    # without adjoints, per solve: the changes of the bodies' twists, the factors of
    # the joints and of a free root, and what bodies and degrees of freedom answer to a
    # unit impulse of a pair along each axis, with the pairs before it
    change_w: Vectors
    change_v: Vectors
    lever_w: Vectors
    lever_v: Vectors
    share: Reals
    root_ww: Symmetrics
    root_wv: Matrices
    root_vv: Symmetrics
    answer_w: Matrices
    answer_v: Matrices
    answer_dv: Vectors
    pair_weight: Matrices  # impulse per velocity, for each pair
    pair_coupling: Matrices  # for each pair and each pair before it
    pair_impulse: Vectors
    pair_adjoint: Vectors
    pair_w: Vectors  # wrench of the adjoint on the first body
    pair_v: Vectors
    # without adjoints, per slot: what a joint passes on to the parent, the effort that
    # it takes, and multipliers, the changes of twist in the adjoint of a solve
    passed_ww: Symmetrics
    passed_wv: Matrices
    passed_vv: Symmetrics
    passed_w: Vectors
    passed_v: Vectors
    effort: Reals
    multiplier_w: Vectors
    multiplier_v: Vectors


@wp.struct
class Offsets:
    """Where the entries of one substep and one solve begin in the scratch arrays."""

    q: int
    q_next: int
    v: int
    v_next: int
    v_body: int  # velocities that the bodies have in this iteration
    ctrl: int
    parameter: int
    body: int
    dof: int
    motion: int  # bodies as they move in this iteration
    contact: int
    report: int
    before: int  # contacts of the solve before
    before_dof: int  # degrees of freedom of the solve before
    corrects: int  # above 0: limits take the velocity of the solve before
    solve: int
    solve_body: int
    solve_dof: int
    solve_contact: int
    pair: int
    reading: int  # bodies of the slot


@wp.func
def offsets_at(m: Model, slot: int, keep: int, s: int, p: int):
    """Offsets of substep ``s`` and solve ``p`` of its first iteration.

    ``keep`` is as in ``offsets_in``.
    """
    return offsets_in(m, slot, keep, s, 0, p)


@wp.func
def offsets_in(m: Model, slot: int, keep: int, s: int, iteration: int, p: int):
    """Offsets of substep ``s`` and solve ``p``, counted over all its iterations.

    ``keep`` is 1 where every substep has entries of its own, as the adjoint needs, and
    0 where a slot's substeps share them. The caller knows the iteration of the solve:
    a GPU divides integers slowly.

    Reads: m.nb, m.nq, m.nv, m.nu, m.nc, m.pairs, m.substeps, m.iterations,
        m.solves, m.parameters, m.given.
    """
    step = slot
    turn = slot
    solve = slot
    before = slot
    iterations = m.substeps * m.iterations
    if keep == 1:
        step = slot * (m.substeps + 1) + wp.min(s, m.substeps)
        turn = slot * (iterations + 1) + wp.min(
            s * m.iterations + iteration, iterations
        )
        solve = m.solves * (slot * iterations + s * m.iterations) + p
        before = solve - 1
    r = Offsets()
    r.q = (slot * (m.substeps + 2) + s) * m.nq
    r.q_next = r.q + m.nq
    r.v = (slot * (iterations + 2) + s) * m.nv
    r.v_next = r.v + m.nv
    r.v_body = r.v
    if iteration > 0:
        # the mean velocities of all iterations are behind those of the substeps
        mean = m.substeps + 1 + s * (m.iterations - 1) + iteration
        r.v_body = (slot * (iterations + 2) + mean) * m.nv
    r.ctrl = slot * m.nu
    r.parameter = slot * m.parameters.size
    r.body = step * (m.nb + 1)
    r.dof = step * m.nv
    r.motion = turn * (m.nb + 1)
    r.contact = slot * m.nc
    if keep == 1:
        r.contact = (slot * m.substeps + s) * m.nc
    r.report = (slot * m.substeps + s) * m.nc
    r.before = before * m.nc
    r.before_dof = before * m.nv
    r.corrects = wp.min(p, m.given - 1)
    r.solve = solve
    r.solve_body = solve * (m.nb + 1)
    r.solve_dof = solve * m.nv
    r.solve_contact = solve * m.nc
    r.pair = solve * m.pairs
    r.reading = slot * (m.nb + 1)
    return r


@wp.func
def offsets_after(m: Model, slot: int, keep: int):
    """Offsets of the returned state, one after the end of the last substep.

    Reads: m.substeps.
    """
    return offsets_at(m, slot, keep, m.substeps + 1, 0)


@wp.func
def root_factors(m: Model, offsets: Offsets, i: int):
    """Where the factors of free root ``i`` are: with one root, in a place of its own.

    Reads: m.roots.
    """
    at = offsets.solve
    if m.roots > 1:
        at = offsets.solve_body + i
    return at
