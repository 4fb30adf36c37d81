"""Between Newton's conventions for a free root and ours; float32, as Newton's states.

Newton's free joint has the velocity of the child's centre of mass, and its force acts
there; ours are those of the child's origin. Both are in world axes, linear part first.
"""

import warp as wp


@wp.kernel
def to_origin(
    # system
    free_root: int,
    com: wp.vec3,
    # in, first index: world
    q: wp.array2d[float],
    qd: wp.array2d[float],
    joint_f: wp.array2d[float],
    # out, first index: world
    v: wp.array2d[float],
    force: wp.array2d[float],
):
    """Move velocities (nv) and generalized forces (nv) to the origin of the root."""
    w = wp.tid()
    for k in range(qd.shape[1]):
        v[w, k] = qd[w, k]
        force[w, k] = joint_f[w, k]
    if free_root != 0:
        turn = wp.quat(q[w, 3], q[w, 4], q[w, 5], q[w, 6])
        arm = wp.quat_rotate(turn, com)
        # v_origin = v_com - omega x arm
        moved = wp.cross(wp.vec3(qd[w, 3], qd[w, 4], qd[w, 5]), arm)
        # the same power at every velocity: torque_origin = torque_com + arm x force
        torque = wp.cross(arm, wp.vec3(joint_f[w, 0], joint_f[w, 1], joint_f[w, 2]))
        for k in range(3):
            v[w, k] = qd[w, k] - moved[k]
            force[w, 3 + k] = joint_f[w, 3 + k] + torque[k]


@wp.kernel
def to_centre_of_mass(
    # system
    free_root: int,
    com: wp.vec3,
    # in, first index: world
    q: wp.array2d[float],
    v: wp.array2d[float],
    # out, first index: world
    qd: wp.array2d[float],
):
    """Move velocities (nv) to the centre of mass of the root."""
    w = wp.tid()
    for k in range(v.shape[1]):
        qd[w, k] = v[w, k]
    if free_root != 0:
        turn = wp.quat(q[w, 3], q[w, 4], q[w, 5], q[w, 6])
        omega = wp.vec3(v[w, 3], v[w, 4], v[w, 5])
        moved = wp.cross(omega, wp.quat_rotate(turn, com))
        for k in range(3):
            qd[w, k] = v[w, k] + moved[k]
