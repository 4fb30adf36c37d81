"""Semi-implicit Euler: new velocities, then coordinates moved with them."""

import warp as wp

from . import quat, real, stage
from .memory import load, store
from .structs import Model, Row, Scratch


@stage
def new_velocity(sc: Scratch, row: Row, k: int):
    """Velocity after the corrector solve."""
    store(sc.v, row.v_next + k, load(sc.v, row.v + k) + load(sc.dv, row.solve_dof + k))


@stage
def new_coordinates(m: Model, sc: Scratch, row: Row, i: int):
    """Coordinates of joint ``i``; a rotation moves by the exponential map."""
    h = m.h
    a = load(m.q_start, i)
    k = load(m.v_start, i)
    if load(m.joint_kind, i) == 0:
        for j in range(3):
            store(
                sc.q,
                row.q_next + a + j,
                load(sc.q, row.q + a + j) + h * load(sc.v, row.v_next + k + j),
            )
        turn = wp.vector(
            h * load(sc.v, row.v_next + k + 3),
            h * load(sc.v, row.v_next + k + 4),
            h * load(sc.v, row.v_next + k + 5),
        )
        # sin(x/2)/x by its argument squared: smooth at rest, no division by zero
        half = real(0.25) * wp.dot(turn, turn)
        r = quat(
            load(sc.q, row.q + a + 3),
            load(sc.q, row.q + a + 4),
            load(sc.q, row.q + a + 5),
            load(sc.q, row.q + a + 6),
        )
        scale = real(0.5) * sinc_of_square(half)
        step = quat(
            scale * turn[0], scale * turn[1], scale * turn[2], cos_of_square(half)
        )
        r1 = wp.normalize(step * r)
        for j in range(4):
            store(sc.q, row.q_next + a + 3 + j, r1[j])
    else:
        store(
            sc.q, row.q_next + a, load(sc.q, row.q + a) + h * load(sc.v, row.v_next + k)
        )


@wp.func
def sinc_of_square(x: real):
    """sin(sqrt(x)) / sqrt(x) for x >= 0."""
    y = real(1.0) - x / real(6.0) * (
        real(1.0) - x / real(20.0) * (real(1.0) - x / real(42.0))
    )
    if x > real(1.0e-3):
        root = wp.sqrt(x)
        y = wp.sin(root) / root
    return y


@wp.func
def cos_of_square(x: real):
    """cos(sqrt(x)) for x >= 0."""
    y = real(1.0) - x / real(2.0) * (
        real(1.0)
        - x / real(12.0) * (real(1.0) - x / real(30.0) * (real(1.0) - x / real(56.0)))
    )
    if x > real(1.0e-3):
        y = wp.cos(wp.sqrt(x))
    return y
