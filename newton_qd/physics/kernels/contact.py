"""Contacts with static obstacles and of moving bodies, linearised for the solves.

The predictor solve takes the normal force as linear in the new velocity. Its normal
impulse may turn negative when a body lifts off, and its friction weight belongs to
the old velocity. So the two corrector solves take the predicted normal impulse,
clipped smoothly at zero, as given, and each takes friction at the slip that the solve
before it leads one to expect. Normal impulses are thus never negative, and friction
stays close to its cone.
"""

import warp as wp

from . import real, scalar, stage, vec3
from .cpp.algebra import cross, dot, transform_point
from .cpp.memory import constant, load, store
from .cpp.numbers import sqrt, uniform
from .cpp.operators import add, div, mul, neg, sub  # noqa: F401
from .cpp.smooth import gate, penetration
from .nearest import touch_obstacle
from .pair import touch_partner
from .parameters import contact_stiffness, friction, total_mass
from .structs import Model, Offsets, Scratch

# Hunt-Crossley factor and clipping switch over these fractions of their natural scale.
DISSIPATION_WIDTH = wp.constant(scalar(0.25))
CLIP_WIDTH = wp.constant(scalar(0.5))
# Steps of Newton's method for a friction weight: from its bound, 3 % off at most.
WEIGHT_STEPS = wp.constant(2)


@stage
def contact_predictor(m: Model, sc: Scratch, offsets: Offsets, c: int):
    """Geometry, and the contact law linearised about the velocity at the start.

    Reads: m.h, m.com, m.contact_body, m.contact_partner, m.contact_smoothing,
        m.slip_velocity, m.dissipation, sc.parameter, sc.pose, sc.twist_w,
        sc.twist_v.
    Writes: sc.point, sc.arm, sc.normal, sc.velocity, sc.load, sc.push, sc.weight_n,
        sc.weight_t.
    """
    i = load(m.contact_body, c)
    x = load(sc.pose, offsets.body + i)
    partner = load(m.contact_partner, c)
    # one law for both: written twice, a GPU's compiler takes twice as long
    r = vec3()
    normal = vec3()
    gap = real()
    if partner < 0:
        r, normal, gap = touch_obstacle(m, sc, offsets, c)
    else:
        r, normal, gap = touch_partner(m, sc, offsets, c)
    vc = load(sc.twist_v, offsets.body + i) + cross(
        load(sc.twist_w, offsets.body + i), r
    )
    if partner >= 0:
        other = offsets.body + load(m.contact_body, partner)
        vc = vc - (load(sc.twist_v, other) + cross(load(sc.twist_w, other), r))
    vn = dot(normal, vc)
    vt = vc - vn * normal
    reach = gap + m.h * vn
    damper = penetration(m.dissipation * vn - scalar(1.0), uniform(DISSIPATION_WIDTH))
    k = (m.h * contact_stiffness(m, sc, offsets)) * damper
    width = uniform(m.contact_smoothing)
    push = k * penetration(reach, width)
    wt = (
        friction(m, sc, offsets)
        * push
        / sqrt(m.slip_velocity * m.slip_velocity + dot(vt, vt))
    )
    store(sc.point, offsets.contact + c, r)
    store(sc.arm, offsets.contact + c, r - transform_point(x, constant(m.com, i)))
    store(sc.normal, offsets.contact + c, normal)
    store(sc.velocity, offsets.contact + c, vc)
    store(sc.load, offsets.contact + c, push)
    store(sc.weight_n, offsets.solve_contact + c, m.h * k * gate(reach, width))
    store(sc.weight_t, offsets.solve_contact + c, wt)
    store(sc.push, offsets.solve_contact + c, push * normal - wt * vt)


@stage
def contact_slip(m: Model, sc: Scratch, offsets: Offsets, c: int):
    """Change of a contact point's velocity by this solve; of a pair, relative.

    Reads: m.contact_body, m.contact_partner, sc.point, sc.change_w, sc.change_v.
    Writes: sc.slip.
    """
    at = offsets.solve_body + load(m.contact_body, c)
    r = load(sc.point, offsets.contact + c)
    dv = load(sc.change_v, at) + cross(load(sc.change_w, at), r)
    partner = load(m.contact_partner, c)
    if partner >= 0:
        other = offsets.solve_body + load(m.contact_body, partner)
        dv = dv - (load(sc.change_v, other) + cross(load(sc.change_w, other), r))
    store(sc.slip, offsets.solve_contact + c, dv)


@stage
def contact_clip(m: Model, sc: Scratch, offsets: Offsets, c: int):
    """Normal impulse: the one of the predictor, ``offsets.before``, clipped at zero.

    Reads: sc.normal, sc.load, sc.weight_n, sc.slip.
    Writes: sc.normal_impulse.
    """
    push = load(sc.load, offsets.contact + c)
    approach = dot(
        load(sc.normal, offsets.contact + c), load(sc.slip, offsets.before + c)
    )
    linear = push - load(sc.weight_n, offsets.before + c) * approach
    normal_impulse = penetration(neg(linear), CLIP_WIDTH * push)
    store(sc.normal_impulse, offsets.report + c, normal_impulse)


@stage
def contact_corrector(m: Model, sc: Scratch, offsets: Offsets, c: int, p: int):
    """Clipped normal impulse, and friction at the slip to expect, in solve ``p``.

    In the last one a pair's friction is given too, from the slip so far: both sides
    get the same impulse, and momentum is conserved whatever hangs on them.

    Reads: m.solves, m.contact_partner, m.slip_velocity, sc.parameter, sc.normal,
        sc.velocity, sc.normal_impulse, sc.weight_t, sc.slip.
    Writes: sc.push, sc.weight_n, sc.weight_t.
    """
    n = load(sc.normal, offsets.contact + c)
    vc = load(sc.velocity, offsets.contact + c)
    v1 = vc + load(sc.slip, offsets.before + c)
    slip = v1 - dot(n, v1) * n
    normal_impulse = load(sc.normal_impulse, offsets.report + c)
    mass = total_mass(m, sc, offsets)
    before = load(sc.weight_t, offsets.before + c)
    wt = friction_weight(
        mass,
        friction(m, sc, offsets) * normal_impulse,
        before,
        dot(slip, slip),
        m.slip_velocity,
    )
    at = offsets.solve_contact + c
    push = normal_impulse * n
    store(sc.weight_n, at, real())
    if load(m.contact_partner, c) < 0 or p < m.solves - 1:
        store(sc.weight_t, at, wt)
        store(sc.push, at, push - wt * (vc - dot(n, vc) * n))
    else:
        store(sc.weight_t, at, real())
        store(sc.push, at, push - (wt * (mass + before) / (mass + wt)) * slip)


@wp.func
def friction_weight(
    mass: real, bound: real, before: real, slip_squared: real, width: scalar
):
    """Weight w = mu J / sqrt(slip^2 + width^2) at the slip that w itself leads to.

    A contact that moves like a point of ``mass`` and slipped by s with the weight
    ``before`` slips by s (mass + before) / (mass + w) with w. At w = ``before`` that is
    s: the mass changes how fast the solves converge, not what they converge to. More
    than a contact moves damps the change of weight, less lets it overshoot. Newton's
    method starts from below, where the law has slip + width in the place of the root.

    Args:
        mass: That of the robot: no less than what the contact moves [kg].
        bound: mu J, the largest friction impulse [N s].
        before: Weight in the solve before [kg].
        slip_squared: Slip after that solve, squared [m^2/s^2].
        width: Velocity below which friction is viscous [m/s].
    """
    e2 = width * width
    momentum = mass + before
    momentum2 = slip_squared * momentum * momentum
    half = (scalar(0.5) * width) * mass
    b = sqrt(momentum2 + half * half) + width * mass - bound
    w = (
        scalar(2.0)
        * bound
        * mass
        / (b + sqrt(b * b + (scalar(4.0) * width) * bound * mass))
    )
    for _ in range(WEIGHT_STEPS):
        inertia = mass + w
        slip2 = momentum2 / (inertia * inertia)
        speed = sqrt(e2 + slip2)
        slope = (e2 + slip2 * mass / inertia) / speed
        w = w - (w * speed - bound) / slope
    return w


@stage
def contact_impulse(sc: Scratch, offsets: Offsets, c: int):
    """Impulse that the corrector applied, friction at the new velocity included.

    Reads: sc.arm, sc.normal, sc.push, sc.weight_t, sc.slip.
    Writes: sc.impulse, sc.angular_impulse.
    """
    n = load(sc.normal, offsets.contact + c)
    dv = load(sc.slip, offsets.solve_contact + c)
    j = load(sc.push, offsets.solve_contact + c) - load(
        sc.weight_t, offsets.solve_contact + c
    ) * (dv - dot(n, dv) * n)
    store(sc.impulse, offsets.report + c, j)
    store(
        sc.angular_impulse,
        offsets.report + c,
        cross(load(sc.arm, offsets.contact + c), j),
    )
