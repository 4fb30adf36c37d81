"""Arrays that the kernels read (Model) and write (Scratch)."""

import warp as wp

from . import mat33, real, transform, vec3


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
    free_root: int  # 1: the origin O follows the position of the first joint
    substeps: int
    h: real  # [s]
    gravity: real  # [m/s^2]
    # bodies, (nb + 1)
    body_parent: wp.array[int]
    joint_kind: wp.array[int]
    q_start: wp.array[int]
    v_start: wp.array[int]
    joint_axis: wp.array[vec3]
    parent_frame: wp.array[transform]
    child_frame_inverse: wp.array[transform]
    mass: wp.array[real]
    composite_mass: wp.array[real]
    com: wp.array[vec3]
    inertia: wp.array[mat33]
    body_levels: int
    body_level_start: wp.array[int]
    body_level: wp.array[int]
    child_start: wp.array[int]
    child: wp.array[int]
    body_dof: wp.array[int]  # last degree of freedom on the way from the root, or -1
    # degrees of freedom, (nv)
    dof_body: wp.array[int]
    dof_coordinate: wp.array[int]  # index in q, -1 for a free joint
    dof_control: wp.array[int]  # index in ctrl, -1 if not driven
    gear: wp.array[real]
    armature: wp.array[real]
    damping: wp.array[real]
    stiffness: wp.array[real]
    spring_rest: wp.array[real]
    limit_lower: wp.array[real]
    limit_upper: wp.array[real]
    limit_stiffness: wp.array[real]
    limit_smoothing: real
    depth: wp.array[int]  # number of dofs on the way from the root, itself included
    path: wp.array2d[int]  # (nv, depth): dofs from the root to k
    descendant_start: wp.array[int]
    descendant: wp.array[int]
    dof_levels: int
    dof_level_start: wp.array[int]
    dof_level: wp.array[int]
    # contacts, (nc)
    contact_start: wp.array[int]  # (nb + 2)
    contact_body: wp.array[int]
    contact_position: wp.array[vec3]
    contact_radius: wp.array[real]
    contact_obstacle: wp.array[int]
    obstacle_kind: wp.array[int]
    obstacle_frame: wp.array[transform]
    obstacle_size: wp.array[vec3]
    contact_stiffness: real
    contact_smoothing: real
    friction: real
    slip_velocity: real
    dissipation: real


@wp.struct
class Scratch:
    """Intermediates of one control step; also the layout of their adjoints.

    First index: slot (a world in flight). Second: substep ``s``, or solve
    ``2 s + pass`` where a substep has two (predictor 0, corrector 1).
    """

    q: wp.array3d[real]  # (slot, substeps + 1, nq)
    v: wp.array3d[real]  # (slot, substeps + 1, nv)
    ctrl: wp.array2d[real]  # (slot, nu)
    fault: wp.array[int]  # (slot,)
    # per substep and body; world axes, spatial vectors about O
    pose: wp.array3d[transform]
    twist_w: wp.array3d[vec3]
    twist_v: wp.array3d[vec3]
    bias_w: wp.array3d[vec3]
    bias_v: wp.array3d[vec3]
    inertia: wp.array3d[mat33]
    moment: wp.array3d[vec3]
    wrench_w: wp.array3d[vec3]
    wrench_v: wp.array3d[vec3]
    # per substep and dof
    axis_w: wp.array3d[vec3]
    axis_v: wp.array3d[vec3]
    # per substep and contact
    point: wp.array3d[vec3]
    arm: wp.array3d[vec3]
    normal: wp.array3d[vec3]
    velocity: wp.array3d[vec3]
    load: wp.array3d[real]
    impulse: wp.array3d[vec3]
    angular_impulse: wp.array3d[vec3]
    normal_impulse: wp.array3d[real]
    # per solve and contact
    push: wp.array3d[vec3]
    weight_n: wp.array3d[real]
    weight_t: wp.array3d[real]
    slip: wp.array3d[vec3]
    # per solve and body: contact weights as added inertia, and contact push
    added_ww: wp.array3d[mat33]
    added_wv: wp.array3d[mat33]
    added_vv: wp.array3d[mat33]
    push_w: wp.array3d[vec3]
    push_v: wp.array3d[vec3]
    # per solve and dof
    H: wp.array4d[real]  # (slot, solve, nv, depth), along the path
    L: wp.array4d[real]
    b: wp.array3d[real]
    dv: wp.array3d[real]
