"""Arrays that the kernels read (Model) and write (Scratch)."""

import warp as wp

from . import mat33, real, scalar, sym33, transform, vec3
from .cpp.memory import TABLES
from .rows import Bodies, Coordinates, Dynamics, Inputs, Outputs, Parameters

_vec3, _mat33, _transform = TABLES[vec3], TABLES[mat33], TABLES[transform]


@wp.struct
class Model:
    """One robot in one scene; shared by all worlds. Row 0 of a body table is the world.

    Bodies are counted from 1 in ``body_parent`` and in every scratch array; level
    lists hold items of equal depth, roots first.
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
    solves: int  # solves of an iteration: predictor and correctors
    h: scalar  # [s]
    gravity: scalar  # [m/s^2]
    rest_q: wp.array[scalar]  # (nq,)
    origin_axis: wp.array[_vec3]  # (3,) what a coordinate adds to the origin O
    # bodies, (nb + 1)
    body_parent: wp.array[int]
    joint_kind: wp.array[int]
    q_start: wp.array[int]
    v_start: wp.array[int]
    joint_axis: wp.array[_vec3]
    parent_frame: wp.array[_transform]
    child_frame_inverse: wp.array[_transform]
    child_moved: wp.array[int]  # 0: the child frame is the identity
    mass: wp.array[scalar]
    com: wp.array[_vec3]
    inertia: wp.array[_mat33]
    isotropic: wp.array[int]  # 1: the inertia does not depend on the rotation
    body_levels: int
    body_level_start: wp.array[int]
    body_level: wp.array[int]
    child_start: wp.array[int]
    child: wp.array[int]
    # degrees of freedom, (nv)
    dof_control: wp.array[int]  # index in ctrl, -1 if not driven
    gear: wp.array[scalar]
    armature: wp.array[scalar]
    damping: wp.array[scalar]
    stiffness: wp.array[scalar]
    spring_rest: wp.array[scalar]
    limit_lower: wp.array[scalar]
    limit_upper: wp.array[scalar]
    limit_stiffness: wp.array[scalar]
    limit_smoothing: scalar
    limit_dissipation: scalar  # [s/rad or s/m]
    # contacts, (nc)
    contact_start: wp.array[int]  # (nb + 2)
    contact_stop: wp.array[int]  # (nb + 1), where the body's rows of pairs begin
    contact_body: wp.array[int]
    contact_position: wp.array[_vec3]
    contact_segment: wp.array[_vec3]
    contact_radius: wp.array[scalar]
    contact_obstacle: wp.array[int]
    contact_partner: wp.array[int]  # row of the other side of a pair, else -1
    contact_lead: wp.array[int]  # row of the side that a pair is measured from
    pair_lead: wp.array[int]  # (pairs,)
    obstacle_kind: wp.array[int]
    obstacle_frame: wp.array[_transform]
    obstacle_size: wp.array[_vec3]
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
    foot: wp.array[int]  # body
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

    Contiguous, one-dimensional; a slot holds one pack of worlds, and :class:`Offsets`
    says where a substep's entries begin.
    """

    q: wp.array[real]
    v: wp.array[real]
    ctrl: wp.array[real]
    parameter: wp.array[real]  # as Parameters says
    # (slots,), 0 or 1: the step failed; its inputs were not finite
    fault: wp.array[real]
    lost: wp.array[real]
    # bodies; world axes, spatial vectors about O
    pose: wp.array[transform]
    twist_w: wp.array[vec3]
    twist_v: wp.array[vec3]
    bias_w: wp.array[vec3]
    bias_v: wp.array[vec3]
    inertia: wp.array[sym33]
    moment: wp.array[vec3]
    wrench_w: wp.array[vec3]
    wrench_v: wp.array[vec3]
    # bodies over the control step, and in the returned state in the world
    body_impulse: wp.array[vec3]
    body_angular_impulse: wp.array[vec3]
    body_normal_impulse: wp.array[real]
    position: wp.array[vec3]
    com: wp.array[vec3]
    com_velocity: wp.array[vec3]
    # readings
    torso_xy: wp.array[real]  # (2 slots,)
    foot_contact: wp.array[real]
    smooth_foot_contact: wp.array[real]
    # degrees of freedom
    axis_w: wp.array[vec3]
    axis_v: wp.array[vec3]
    # contacts
    point: wp.array[vec3]
    arm: wp.array[vec3]
    normal: wp.array[vec3]
    velocity: wp.array[vec3]
    gap: wp.array[real]
    impulse: wp.array[vec3]
    angular_impulse: wp.array[vec3]
    normal_impulse: wp.array[real]
    # contacts, per solve: the law at the velocity expected, and linearised about it
    load: wp.array[real]
    push_n: wp.array[real]
    push: wp.array[vec3]
    weight_n: wp.array[real]
    weight_t: wp.array[real]
    slip: wp.array[vec3]
    # joints, per solve: impulse at the old velocity, and what resists the change
    joint_push: wp.array[real]
    joint_weight: wp.array[real]
    # what a solve finds: the change of twist of each body, and of each velocity
    change_w: wp.array[vec3]
    change_v: wp.array[vec3]
    dv: wp.array[real]
    # without adjoints, per solve: the factors of the joints and of a free root, and
    # what bodies and degrees of freedom answer to a unit impulse of a pair along each
    # axis, with the pairs before it
    lever_w: wp.array[vec3]
    lever_v: wp.array[vec3]
    share: wp.array[real]
    root_ww: wp.array[sym33]
    root_wv: wp.array[mat33]
    root_vv: wp.array[sym33]
    answer_w: wp.array[mat33]
    answer_v: wp.array[mat33]
    answer_dv: wp.array[vec3]
    pair_weight: wp.array[mat33]  # impulse per velocity, for each pair
    pair_coupling: wp.array[mat33]  # for each pair and each pair before it
    pair_impulse: wp.array[vec3]
    pair_adjoint: wp.array[vec3]
    # without adjoints, per slot: what a joint passes on to the parent, the effort that
    # it takes, and multipliers, the changes of twist in the adjoint of a solve
    passed_ww: wp.array[sym33]
    passed_wv: wp.array[mat33]
    passed_vv: wp.array[sym33]
    passed_w: wp.array[vec3]
    passed_v: wp.array[vec3]
    effort: wp.array[real]
    multiplier_w: wp.array[vec3]
    multiplier_v: wp.array[vec3]


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
    """Offsets of substep ``s`` and solve ``p``, counted over all its iterations.

    ``keep`` is 1 where every substep has entries of its own, as the adjoint needs, and
    0 where a slot's substeps share them.

    Reads: m.nb, m.nq, m.nv, m.nu, m.nc, m.pairs, m.substeps, m.iterations,
        m.solves, m.parameters, m.given.
    """
    step = slot
    turn = slot
    solve = slot
    before = slot
    iteration = p // m.solves
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
