"""Between Newton's arrays and the rows of a step; float32, as Newton's states.

Newton's free joint has the velocity of the child's centre of mass, and its force acts
there; ours are those of the child's origin. Both are in world axes, linear part first.
The force of every degree of freedom is its control.
"""

import warp as wp

from .rows import Inputs, Outputs

# Warp declares no shape for arrays of kernels.
# pyright: reportAttributeAccessIssue=false


@wp.kernel
def write_rows(
    # system
    free_root: int,
    com: wp.vec3,
    # in, first index: world
    q: wp.array2d[float],
    qd: wp.array2d[float],
    joint_f: wp.array2d[float],
    at: Inputs,
    # out
    x: wp.array2d[float],
):
    """Write coordinates, and velocities and forces moved to the origin of the root.

    Reads: q, qd, joint_f.
    Writes: x.
    """
    w = wp.tid()
    nq = q.shape[1]
    nv = qd.shape[1]
    for k in range(nq):
        x[w, at.q + k] = q[w, k]
    for k in range(nv):
        x[w, at.v + k] = qd[w, k]
        x[w, at.control + k] = joint_f[w, k]
    if free_root != 0:
        arm = wp.quat_rotate(wp.quat(q[w, 3], q[w, 4], q[w, 5], q[w, 6]), com)
        # v_origin = v_com - omega x arm
        moved = wp.cross(wp.vec3(qd[w, 3], qd[w, 4], qd[w, 5]), arm)
        # the same power at every velocity: torque_origin = torque_com + arm x force
        torque = wp.cross(arm, wp.vec3(joint_f[w, 0], joint_f[w, 1], joint_f[w, 2]))
        for k in range(3):
            x[w, at.v + k] = qd[w, k] - moved[k]
            x[w, at.control + 3 + k] = joint_f[w, 3 + k] + torque[k]


@wp.kernel
def read_rows(
    # system
    free_root: int,
    com: wp.vec3,
    # in
    at: Outputs,
    y: wp.array2d[float],
    # out, first index: world
    q: wp.array2d[float],
    qd: wp.array2d[float],
    impulse: wp.array2d[float],
    normal_impulse: wp.array2d[float],
    fault: wp.array[float],
):
    """Read a step's results, with velocities moved to the root's centre of mass.

    Reads: y.
    Writes: q, qd, impulse, normal_impulse, fault.
    """
    w = wp.tid()
    nq = q.shape[1]
    nv = qd.shape[1]
    for k in range(nq):
        q[w, k] = y[w, at.q + k]
    for k in range(nv):
        qd[w, k] = y[w, at.v + k]
    for k in range(impulse.shape[1]):
        impulse[w, k] = y[w, at.impulse + k]
    for k in range(normal_impulse.shape[1]):
        normal_impulse[w, k] = y[w, at.normal_impulse + k]
    fault[w] = y[w, at.fault]
    if free_root != 0:
        turn = at.q + 3
        spin = at.v + 3
        arm = wp.quat_rotate(
            wp.quat(y[w, turn], y[w, turn + 1], y[w, turn + 2], y[w, turn + 3]), com
        )
        moved = wp.cross(wp.vec3(y[w, spin], y[w, spin + 1], y[w, spin + 2]), arm)
        for k in range(3):
            qd[w, k] = y[w, at.v + k] + moved[k]
