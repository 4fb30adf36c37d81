"""Semi-implicit Euler: new velocities, then coordinates moved with them."""

from newton_qd.physics.kinds import JointKind

from . import scalar, stage
from .cpp.algebra import component, normalize, quaternion, vector
from .cpp.memory import load, store
from .cpp.operators import add, mul  # noqa: F401
from .cpp.smooth import turn_by
from .structs import Model, Offsets, Scratch


@stage
def mean_velocity(sc: Scratch, offsets: Offsets, ahead: Offsets, k: int):
    """Velocity halfway through the substep, where the iteration ``ahead`` takes it.

    Reads: sc.v, sc.dv.
    Writes: sc.v.
    """
    change = scalar(0.5) * load(sc.dv, offsets.solve_dof + k)
    store(sc.v, ahead.v_body + k, load(sc.v, offsets.v + k) + change)


@stage
def new_velocity(sc: Scratch, offsets: Offsets, k: int):
    """Velocity after the corrector solve.

    Reads: sc.v, sc.dv.
    Writes: sc.v.
    """
    store(
        sc.v,
        offsets.v_next + k,
        load(sc.v, offsets.v + k) + load(sc.dv, offsets.solve_dof + k),
    )


@stage
def new_coordinates(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Coordinates of joint ``i``; a rotation moves by the exponential map.

    Reads: m.h, m.joint_kind, m.q_start, m.v_start, sc.q, sc.v.
    Writes: sc.q.
    """
    h = m.h
    a = load(m.q_start, i)
    k = load(m.v_start, i)
    if load(m.joint_kind, i) == JointKind.FREE:
        for j in range(3):
            store(
                sc.q,
                offsets.q_next + a + j,
                load(sc.q, offsets.q + a + j) + h * load(sc.v, offsets.v_next + k + j),
            )
        turn = h * vector(
            load(sc.v, offsets.v_next + k + 3),
            load(sc.v, offsets.v_next + k + 4),
            load(sc.v, offsets.v_next + k + 5),
        )
        r = quaternion(
            load(sc.q, offsets.q + a + 3),
            load(sc.q, offsets.q + a + 4),
            load(sc.q, offsets.q + a + 5),
            load(sc.q, offsets.q + a + 6),
        )
        r1 = normalize(turn_by(turn) * r)
        for j in range(4):
            store(sc.q, offsets.q_next + a + 3 + j, component(r1, j))
    else:
        store(
            sc.q,
            offsets.q_next + a,
            load(sc.q, offsets.q + a) + h * load(sc.v, offsets.v_next + k),
        )
