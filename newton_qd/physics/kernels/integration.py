"""Semi-implicit Euler: new velocities, then coordinates moved with them."""

import warp as wp

from . import quat, real, stage
from .structs import Model, Scratch


@stage
def new_velocity(m: Model, sc: Scratch, slot: int, s: int, k: int):
    """Velocity after the corrector solve."""
    sc.v[slot, s + 1, k] = sc.v[slot, s, k] + sc.dv[slot, 2 * s + 1, k]


@stage
def new_coordinates(m: Model, sc: Scratch, slot: int, s: int, i: int):
    """Coordinates of joint ``i``; a rotation moves by the exponential map."""
    h = m.h
    a = m.q_start[i]
    k = m.v_start[i]
    if m.joint_kind[i] == 0:
        for j in range(3):
            sc.q[slot, s + 1, a + j] = sc.q[slot, s, a + j] + h * sc.v[slot, s + 1, k + j]
        turn = wp.vector(
            h * sc.v[slot, s + 1, k + 3],
            h * sc.v[slot, s + 1, k + 4],
            h * sc.v[slot, s + 1, k + 5],
        )
        # sin(x/2)/x by its argument squared: smooth at rest, no division by zero
        half = real(0.25) * wp.dot(turn, turn)
        r = quat(
            sc.q[slot, s, a + 3],
            sc.q[slot, s, a + 4],
            sc.q[slot, s, a + 5],
            sc.q[slot, s, a + 6],
        )
        scale = real(0.5) * sinc_of_square(half)
        step = quat(
            scale * turn[0], scale * turn[1], scale * turn[2], cos_of_square(half)
        )
        r1 = wp.normalize(step * r)
        for j in range(4):
            sc.q[slot, s + 1, a + 3 + j] = r1[j]
    else:
        sc.q[slot, s + 1, a] = sc.q[slot, s, a] + h * sc.v[slot, s + 1, k]


@wp.func
def sinc_of_square(x: real):
    """sin(sqrt(x)) / sqrt(x) for x >= 0."""
    y = real(1.0) - x / real(6.0) * (real(1.0) - x / real(20.0) * (real(1.0) - x / real(42.0)))
    if x > real(1.0e-3):
        root = wp.sqrt(x)
        y = wp.sin(root) / root
    return y


@wp.func
def cos_of_square(x: real):
    """cos(sqrt(x)) for x >= 0."""
    y = real(1.0) - x / real(2.0) * (
        real(1.0) - x / real(12.0) * (real(1.0) - x / real(30.0) * (real(1.0) - x / real(56.0)))
    )
    if x > real(1.0e-3):
        y = wp.cos(wp.sqrt(x))
    return y
