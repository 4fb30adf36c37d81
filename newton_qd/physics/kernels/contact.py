"""Contacts of one robot sphere with one obstacle, linearised for the two solves.

The predictor solve takes the normal force as linear in the new velocity. Its normal
impulse may turn negative when a body lifts off, and its friction weight belongs to
the old velocity; so the corrector solve takes the predicted normal impulse, clipped
smoothly at zero, as given, and friction at the predicted slip. Normal impulses are
thus never negative and friction stays close to its cone.
"""

import warp as wp

from . import real, stage, vec3
from .smooth import gate, penetration
from .structs import Model, Scratch

# Hunt-Crossley factor and clipping switch over these fractions of their natural scale.
DISSIPATION_WIDTH = wp.constant(real(0.25))
CLIP_WIDTH = wp.constant(real(0.5))


@wp.func
def obstacle_normal(m: Model, o: int, at: vec3):
    """Outward unit normal at the obstacle point nearest to ``at`` (obstacle frame)."""
    n = vec3(real(0.0), real(0.0), real(1.0))
    if m.obstacle_kind[o] == 1:
        half = m.obstacle_size[o][1]
        nearest = vec3(real(0.0), real(0.0), wp.clamp(at[2], -half, half))
        n = wp.normalize(at - nearest)
    return n


@wp.func
def obstacle_distance(m: Model, o: int, at: vec3):
    """Signed distance of ``at`` (obstacle frame) from the obstacle's surface [m]."""
    d = at[2]
    if m.obstacle_kind[o] == 1:
        half = m.obstacle_size[o][1]
        nearest = vec3(real(0.0), real(0.0), wp.clamp(at[2], -half, half))
        d = wp.length(at - nearest) - m.obstacle_size[o][0]
    return d


@stage
def contact_predictor(m: Model, sc: Scratch, slot: int, s: int, c: int):
    """Geometry, and the contact law linearised about the velocity at the start."""
    i = m.contact_body[c]
    o = m.contact_obstacle[c]
    x = sc.pose[slot, s, i]
    center = wp.transform_point(x, m.contact_position[c])
    frame = sc.pose[slot, s, 0] * m.obstacle_frame[o]
    at = wp.transform_point(wp.transform_inverse(frame), center)
    normal = wp.transform_vector(frame, obstacle_normal(m, o, at))
    radius = m.contact_radius[c]
    gap = obstacle_distance(m, o, at) - radius
    r = center - radius * normal
    vc = sc.twist_v[slot, s, i] + wp.cross(sc.twist_w[slot, s, i], r)
    vn = wp.dot(normal, vc)
    vt = vc - vn * normal
    reach = gap + m.h * vn
    damper = penetration(m.dissipation * vn - real(1.0), DISSIPATION_WIDTH)
    k = m.h * m.contact_stiffness * damper
    load = k * penetration(reach, m.contact_smoothing)
    wt = m.friction * load / wp.sqrt(wp.dot(vt, vt) + m.slip_velocity * m.slip_velocity)
    t = 2 * s
    sc.point[slot, s, c] = r
    sc.arm[slot, s, c] = r - wp.transform_point(x, m.com[i])
    sc.normal[slot, s, c] = normal
    sc.velocity[slot, s, c] = vc
    sc.load[slot, s, c] = load
    sc.weight_n[slot, t, c] = m.h * k * gate(reach, m.contact_smoothing)
    sc.weight_t[slot, t, c] = wt
    sc.push[slot, t, c] = load * normal - wt * vt


@stage
def contact_slip(m: Model, sc: Scratch, slot: int, s: int, t: int, c: int):
    """Change of a contact point's velocity by the solve ``t``."""
    r = sc.point[slot, s, c]
    dv = vec3()
    last = m.body_dof[m.contact_body[c]]
    for d in range(m.depth[last]):
        k = m.path[last, d]
        j = sc.axis_v[slot, s, k] + wp.cross(sc.axis_w[slot, s, k], r)
        dv = dv + j * sc.dv[slot, t, k]
    sc.slip[slot, t, c] = dv


@stage
def contact_corrector(m: Model, sc: Scratch, slot: int, s: int, c: int):
    """Clipped normal impulse, and friction at the predicted slip."""
    t = 2 * s
    n = sc.normal[slot, s, c]
    vc = sc.velocity[slot, s, c]
    dv = sc.slip[slot, t, c]
    load = sc.load[slot, s, c]
    linear = load - sc.weight_n[slot, t, c] * wp.dot(n, dv)
    normal_impulse = penetration(-linear, CLIP_WIDTH * load)
    v1 = vc + dv
    slip = v1 - wp.dot(n, v1) * n
    wt = (
        m.friction
        * normal_impulse
        / wp.sqrt(wp.dot(slip, slip) + m.slip_velocity * m.slip_velocity)
    )
    sc.normal_impulse[slot, s, c] = normal_impulse
    sc.weight_n[slot, t + 1, c] = real(0.0)
    sc.weight_t[slot, t + 1, c] = wt
    sc.push[slot, t + 1, c] = normal_impulse * n - wt * (vc - wp.dot(n, vc) * n)


@stage
def contact_impulse(sc: Scratch, slot: int, s: int, c: int):
    """Impulse that the corrector applied, friction at the new velocity included."""
    t = 2 * s + 1
    n = sc.normal[slot, s, c]
    dv = sc.slip[slot, t, c]
    j = sc.push[slot, t, c] - sc.weight_t[slot, t, c] * (dv - wp.dot(n, dv) * n)
    sc.impulse[slot, s, c] = j
    sc.angular_impulse[slot, s, c] = wp.cross(sc.arm[slot, s, c], j)
