"""Contacts with static obstacles and of moving bodies, linearised for the solves.

The normal impulse is a function of the new velocity: the spring is evaluated where the
contact will be, and so is the damping. The solves before ``given`` take it as linear
about the velocity that the solve before them found, which is Newton's method on the
implicit law. The law falls with the velocity and is convex, so a linear impulse is
never above the law. It can be below zero where a body lifts off. So the solves from
``given`` on take the impulse found so far, clipped smoothly at zero, as given.

Each solve takes friction at the slip that the solve before it leads one to expect: as
a weight, which answers the new velocity. A contact that then slips by more would leave
its cone, so where the normal impulse is given only once, most of the friction is given
with it. The rest, one eighth, keeps what sticks from being thrown: with all of it given
a light foot gains energy.
"""

import warp as wp

from . import pairs, real, scalar, stage, vec3
from .cpp.algebra import cross, dot, transform_point
from .cpp.memory import constant, load, store
from .cpp.numbers import sqrt, uniform
from .cpp.operators import add, div, mul, neg, sub  # noqa: F401
from .cpp.smooth import friction_weight, gate, penetration
from .joints import DISSIPATION_WIDTH
from .nearest import touch_obstacle
from .pair import touch_partner
from .parameters import contact_stiffness, friction, total_mass
from .structs import Model, Offsets, Scratch

PAIRS = wp.constant(pairs)
# Clipping switches over this fraction of its natural scale.
CLIP_WIDTH = wp.constant(scalar(0.5))


@wp.func
def normal_law(
    m: Model, sc: Scratch, offsets: Offsets, gap: real, vn: real, follows: scalar
):
    """Normal impulse at the normal velocity ``vn``, and its slope [N s, kg].

    The spring is at the end of the substep, and the dissipation factor of Hunt and
    Crossley (1975) is that of ``vn``. ``follows`` is 1 where the slope is also that of
    the factor, and 0 where the factor stays.

    Reads: m.h, m.contact_smoothing, m.dissipation, sc.parameter.
    """
    h = m.h
    k = h * contact_stiffness(m, sc, offsets)
    width = uniform(m.contact_smoothing)
    reach = gap + h * vn
    depth = k * penetration(reach, width)
    rate = m.dissipation * vn - scalar(1.0)
    damper = penetration(rate, uniform(DISSIPATION_WIDTH))
    factor = (follows * m.dissipation) * gate(rate, uniform(DISSIPATION_WIDTH))
    slope = (h * k) * (damper * gate(reach, width)) + depth * factor
    return depth * damper, slope


@stage
def contact_predictor(m: Model, sc: Scratch, offsets: Offsets, c: int):
    """Geometry, and the contact law linearised about the velocity at the start.

    Reads: m.com, m.contact_body, m.contact_partner, m.slip_velocity, sc.parameter,
        sc.pose, sc.twist_w, sc.twist_v, m.follows.
    Writes: sc.point, sc.arm, sc.normal, sc.velocity, sc.gap, sc.load, sc.push_n,
        sc.push, sc.weight_n, sc.weight_t.
    """
    i = load(m.contact_body, c)
    x = load(sc.pose, offsets.body + i)
    partner = int(-1)
    if PAIRS:
        partner = load(m.contact_partner, c)
    # one law for both: written twice, a GPU's compiler takes twice as long
    r = vec3()
    normal = vec3()
    gap = real()
    if partner < 0:
        r, normal, gap = touch_obstacle(m, sc, offsets, c)
    else:
        r, normal, gap = touch_partner(m, sc, offsets, c)
    vc = load(sc.twist_v, offsets.motion + i) + cross(
        load(sc.twist_w, offsets.motion + i), r
    )
    if partner >= 0:
        other = offsets.motion + load(m.contact_body, partner)
        vc = vc - (load(sc.twist_v, other) + cross(load(sc.twist_w, other), r))
    vn = dot(normal, vc)
    vt = vc - vn * normal
    push, wn = normal_law(m, sc, offsets, gap, vn, m.follows)
    wt = (
        friction(m, sc, offsets)
        * push
        / sqrt(m.slip_velocity * m.slip_velocity + dot(vt, vt))
    )
    store(sc.point, offsets.contact + c, r)
    store(sc.arm, offsets.contact + c, r - transform_point(x, constant(m.com, i)))
    store(sc.normal, offsets.contact + c, normal)
    store(sc.velocity, offsets.contact + c, vc)
    store(sc.gap, offsets.contact + c, gap)
    store(sc.load, offsets.solve_contact + c, push)
    store(sc.push_n, offsets.solve_contact + c, push)
    store(sc.weight_n, offsets.solve_contact + c, wn)
    store(sc.weight_t, offsets.solve_contact + c, wt)
    store(sc.push, offsets.solve_contact + c, push * normal - wt * vt)


@wp.func
def clipped_impulse(sc: Scratch, offsets: Offsets, c: int):
    """Normal impulse of contact ``c`` in the solve before: linear, clipped at zero.

    The clip is smooth, over a part of the law where it was linearised.

    Reads: sc.normal, sc.load, sc.push_n, sc.weight_n, sc.slip.
    """
    before = offsets.before + c
    approach = dot(load(sc.normal, offsets.contact + c), load(sc.slip, before))
    linear = load(sc.push_n, before) - load(sc.weight_n, before) * approach
    return penetration(neg(linear), CLIP_WIDTH * load(sc.load, before))


@wp.func
def expected_weight(
    m: Model, sc: Scratch, offsets: Offsets, c: int, applied: real, slip: vec3
):
    """Friction weight at the slip to expect after the solve before.

    Reads: m.slip_velocity, sc.parameter, sc.weight_t.
    """
    return friction_weight(
        total_mass(m, sc, offsets),
        friction(m, sc, offsets) * applied,
        applied,
        load(sc.weight_t, offsets.before + c),
        dot(slip, slip),
        m.slip_velocity,
    )


@stage
def contact_corrector(m: Model, sc: Scratch, offsets: Offsets, c: int):
    """The law linearised about the velocity after the solve before, with friction.

    Reads: sc.parameter, sc.normal, sc.velocity, sc.gap, sc.load, sc.push_n,
        sc.weight_n, sc.weight_t, sc.slip.
    Writes: sc.load, sc.push_n, sc.push, sc.weight_n, sc.weight_t.
    """
    n = load(sc.normal, offsets.contact + c)
    vc = load(sc.velocity, offsets.contact + c)
    vn = dot(n, vc)
    v1 = vc + load(sc.slip, offsets.before + c)
    vn1 = dot(n, v1)
    applied = clipped_impulse(sc, offsets, c)
    wt = expected_weight(m, sc, offsets, c, applied, v1 - vn1 * n)
    gap = load(sc.gap, offsets.contact + c)
    law, wn = normal_law(m, sc, offsets, gap, vn1, scalar(1.0))
    # the impulse at the velocity at the start
    push = law + wn * (vn1 - vn)
    at = offsets.solve_contact + c
    store(sc.load, at, law)
    store(sc.push_n, at, push)
    store(sc.weight_n, at, wn)
    store(sc.weight_t, at, wt)
    store(sc.push, at, push * n - wt * (vc - vn * n))


@stage
def contact_given(m: Model, sc: Scratch, offsets: Offsets, c: int, p: int):
    """Given normal impulse, clipped at zero, and friction at the slip to expect.

    Reads: m.given, sc.parameter, sc.normal, sc.velocity, sc.load, sc.push_n,
        sc.weight_n, sc.weight_t, sc.slip, m.contact_partner, m.iterations, m.solves,
        m.friction_answers.
    Writes: sc.load, sc.push_n, sc.push, sc.weight_n, sc.weight_t.
    """
    n = load(sc.normal, offsets.contact + c)
    vc = load(sc.velocity, offsets.contact + c)
    v1 = vc + load(sc.slip, offsets.before + c)
    slip = v1 - dot(n, v1) * n
    applied = load(sc.push_n, offsets.before + c)
    if p == m.given:
        applied = clipped_impulse(sc, offsets, c)
    wt = expected_weight(m, sc, offsets, c, applied, slip)
    at = offsets.solve_contact + c
    store(sc.load, at, load(sc.load, offsets.before + c))
    store(sc.push_n, at, applied)
    store(sc.weight_n, at, real())
    push = applied * n
    partner = int(-1)
    if PAIRS:
        partner = load(m.contact_partner, c)
    if partner < 0 or p < m.iterations * m.solves - 1:
        # what of the friction is not given answers the new velocity
        answers = m.friction_answers * wt
        given = (scalar(1.0) - m.friction_answers) * wt
        store(sc.weight_t, at, answers)
        store(sc.push, at, push - given * slip - answers * (vc - dot(n, vc) * n))
    else:
        mass = total_mass(m, sc, offsets)
        before = load(sc.weight_t, offsets.before + c)
        store(sc.weight_t, at, real())
        store(sc.push, at, push - (wt * (mass + before) / (mass + wt)) * slip)


@stage
def contact_impulse(sc: Scratch, offsets: Offsets, c: int):
    """Impulse that the last solve applied, friction at the new velocity included.

    Reads: sc.arm, sc.normal, sc.push_n, sc.push, sc.weight_t, sc.slip.
    Writes: sc.impulse, sc.angular_impulse, sc.normal_impulse.
    """
    at = offsets.solve_contact + c
    n = load(sc.normal, offsets.contact + c)
    dv = load(sc.slip, at)
    j = load(sc.push, at) - load(sc.weight_t, at) * (dv - dot(n, dv) * n)
    store(sc.normal_impulse, offsets.report + c, load(sc.push_n, at))
    store(sc.impulse, offsets.report + c, j)
    store(
        sc.angular_impulse,
        offsets.report + c,
        cross(load(sc.arm, offsets.contact + c), j),
    )
