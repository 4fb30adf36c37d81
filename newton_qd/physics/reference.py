"""Reference kinematics in NumPy with float64: slow, simple and independent of Warp.

The default pose of a robot is computed with it. Tests compare the kernels with it.
Quaternions are (x, y, z, w).
"""

from __future__ import annotations

import numpy as np

from newton_qd.physics.system import JointKind, System


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns what ``np.cross`` does of two vectors (3,), in a tenth of its time."""
    ax, ay, az = a
    bx, by, bz = b
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def quaternion_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns the rotation ``b`` followed by ``a``, both (4,)."""
    vector = a[3] * b[:3] + b[3] * a[:3] + _cross(a[:3], b[:3])
    return np.append(vector, a[3] * b[3] - a[:3] @ b[:3])


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Returns the (3, 3) matrix of a unit quaternion (4,)."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def axis_quaternion(axis: np.ndarray, angle: float) -> np.ndarray:
    """Returns the rotation (4,) by ``angle`` [rad] about a unit axis (3,)."""
    return np.append(np.sin(angle / 2) * axis, np.cos(angle / 2))


def rpy_quaternion(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Returns the quaternion (4,) of URDF's roll, pitch and yaw [rad].

    URDF rotates about the fixed x axis, then about y, then about z.
    """
    x, y, z = np.eye(3)
    about_zy = quaternion_product(axis_quaternion(z, yaw), axis_quaternion(y, pitch))
    return quaternion_product(about_zy, axis_quaternion(x, roll))


def compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns the composition (7,) of two frames.

    Args:
        a: (7,) frame in an outer frame, position [m] and quaternion.
        b: (7,) frame in ``a``, position [m] and quaternion. The result is this frame
            in the outer frame.
    """
    position = a[:3] + rotation_matrix(a[3:]) @ b[:3]
    return np.concatenate([position, quaternion_product(a[3:], b[3:])])


def inverse(a: np.ndarray) -> np.ndarray:
    """Returns the inverse of a frame (7,)."""
    conjugate = a[3:] * np.array([-1.0, -1.0, -1.0, 1.0])
    return np.concatenate([-(rotation_matrix(conjugate) @ a[:3]), conjugate])


def _joint_motion(system: System, joint: int, q: np.ndarray) -> np.ndarray:
    """Returns the frame (7,) of the child side of a joint in its parent side."""
    kind = JointKind(system.joint_kind[joint])
    start = system.q_start[joint]
    axis = system.joint_axis[joint]
    if kind == JointKind.FREE:
        quaternion = q[start + 3 : start + 7]
        return np.concatenate(
            [q[start : start + 3], quaternion / np.linalg.norm(quaternion)]
        )
    if kind == JointKind.REVOLUTE:
        return np.concatenate([np.zeros(3), axis_quaternion(axis, float(q[start]))])
    return np.concatenate([axis * q[start], [0.0, 0.0, 0.0, 1.0]])


def body_frames(system: System, q: np.ndarray) -> np.ndarray:
    """Returns the world frames (nb, 7) of the bodies at coordinates ``q`` (nq,)."""
    q = np.asarray(q, dtype=np.float64)
    frames = np.empty((system.nb, 7))
    for body, parent in enumerate(system.parent):
        joint = compose(system.parent_frame[body], _joint_motion(system, body, q))
        if parent >= 0:
            joint = compose(frames[parent], joint)
        frames[body] = compose(joint, inverse(system.child_frame[body]))
    return frames


def jacobians(system: System, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the Jacobians of all bodies, in world axes.

    Args:
        system: The robot.
        q: (nq,) coordinates.

    Returns:
        Linear Jacobian (nb, 3, nv) of the centre of mass, and angular Jacobian
        (nb, 3, nv). Column i is the velocity of a body for a unit velocity of degree
        of freedom i.
    """
    q = np.asarray(q, dtype=np.float64)
    frames = body_frames(system, q)
    linear = np.zeros((system.nb, 3, system.nv))
    angular = np.zeros((system.nb, 3, system.nv))
    sides = [compose(*pair) for pair in zip(frames, system.child_frame, strict=True)]
    axes = [
        rotation_matrix(side[3:]) @ axis
        for side, axis in zip(sides, system.joint_axis, strict=True)
    ]
    for body in range(system.nb):
        com = compose(frames[body], np.append(system.com[body], [0, 0, 0, 1.0]))[:3]
        joint = body
        while joint >= 0:
            dof = system.v_start[joint]
            arm, axis = com - sides[joint][:3], axes[joint]
            if system.joint_kind[joint] == JointKind.FREE:
                linear[body, :, dof : dof + 3] = np.eye(3)
                # Column i of -[arm]x is e_i x arm.
                linear[body, :, dof + 3 : dof + 6] = np.cross(np.eye(3), arm).T
                angular[body, :, dof + 3 : dof + 6] = np.eye(3)
            elif system.joint_kind[joint] == JointKind.REVOLUTE:
                linear[body, :, dof] = _cross(axis, arm)
                angular[body, :, dof] = axis
            else:
                linear[body, :, dof] = axis
            joint = system.parent[joint]
    return linear, angular


def mass_matrix(system: System, q: np.ndarray) -> np.ndarray:
    """Returns the mass matrix (nv, nv), summed from the kinetic energy of each body."""
    linear, angular = jacobians(system, q)
    frames = body_frames(system, q)
    total = np.diag(system.armature).astype(np.float64)
    for body in range(system.nb):
        rotation = rotation_matrix(frames[body, 3:])
        inertia = rotation @ system.inertia[body] @ rotation.T
        total += system.mass[body] * linear[body].T @ linear[body]
        total += angular[body].T @ inertia @ angular[body]
    return total


def origin_axes(system: System) -> np.ndarray:
    """Returns the derivative of the origin O with respect to the first coordinates.

    O is the origin of spatial vectors. With a free root, O is the position of the root.
    Otherwise O starts at the origin of the world and moves with the prismatic joints at
    the root.

    Returns:
        (3, 3) row i is the motion of O per metre of coordinate i, world axes [-].
    """
    if system.joint_kind[0] == JointKind.FREE:
        return np.eye(3)
    axes = np.zeros((3, 3))
    q = np.zeros(system.nq)
    free = system.joint_kind == JointKind.FREE
    q[system.q_start[free] + 6] = 1.0  # of a quaternion xyzw
    frames = body_frames(system, q)
    for body in range(min(3, system.nb)):
        slides = system.joint_kind[body] == JointKind.PRISMATIC
        if not slides or system.parent[body] != body - 1:
            break
        side = compose(frames[body], system.child_frame[body])
        axes[body] = rotation_matrix(side[3:]) @ system.joint_axis[body]
    return axes


def penetration(gap: float, width: float) -> float:
    """Returns the kernels' smooth ``max(-gap, 0)``. It is exact for |gap| >= width."""
    if abs(gap) >= width:
        return max(-gap, 0.0)
    return (width - gap) ** 3 * (3 * width + gap) / (16 * width**3)


def lowest_contact(
    system: System, q: np.ndarray, contacts: np.ndarray | None = None
) -> float:
    """Returns the height above z = 0 of the lowest ground-contact sphere [m].

    Args:
        system: The system.
        q: (nq,) coordinates.
        contacts: Rows of the contact tables; ``None``: all ground contacts.
    """
    frames = body_frames(system, q)
    ground = system.ground_contacts if contacts is None else contacts
    heights = [
        compose(frames[body], np.append(position, [0, 0, 0, 1.0]))[2] - radius
        for body, position, radius in zip(
            system.contact_body[ground],
            system.contact_position[ground],
            system.contact_radius[ground],
            strict=True,
        )
    ]
    return float(min(heights))
