"""Moving one world between the caller's arrays and the scratch, with adjoints."""

import warp as wp

from . import real, sync, vec3
from .structs import Model, Scratch


@wp.struct
class Values:
    """A control step's inputs and outputs, or their adjoints; first index: world."""

    q: wp.array2d[real]
    v: wp.array2d[real]
    ctrl: wp.array2d[real]
    q_new: wp.array2d[real]
    v_new: wp.array2d[real]
    impulse: wp.array3d[real]  # (world, body, 6)
    normal_impulse: wp.array2d[real]  # (world, body)
    fault: wp.array[real]  # (world,)


@wp.func
def load_world(
    m: Model, sc: Scratch, g: Scratch, slot: int, x: Values, x_bar: Values, w: int,
    lane: int, lanes: int,
):
    """Copy the inputs of world ``w`` into its slot."""
    for k in range(lane, m.nq, lanes):
        sc.q[slot, 0, k] = x.q[w, k]
    for k in range(lane, m.nv, lanes):
        sc.v[slot, 0, k] = x.v[w, k]
    for k in range(lane, m.nu, lanes):
        sc.ctrl[slot, k] = x.ctrl[w, k]
    sync()


@wp.func_grad(load_world)
def adj_load_world(
    m: Model, sc: Scratch, g: Scratch, slot: int, x: Values, x_bar: Values, w: int,
    lane: int, lanes: int,
):
    """Hand the adjoints of the inputs to the caller; exactly 0 for a faulty world."""
    good = sc.fault[slot] == 0
    for k in range(lane, m.nq, lanes):
        x_bar.q[w, k] = wp.where(good, g.q[slot, 0, k], real(0.0))
        g.q[slot, 0, k] = real(0.0)
    for k in range(lane, m.nv, lanes):
        x_bar.v[w, k] = wp.where(good, g.v[slot, 0, k], real(0.0))
        g.v[slot, 0, k] = real(0.0)
    for k in range(lane, m.nu, lanes):
        x_bar.ctrl[w, k] = wp.where(good, g.ctrl[slot, k], real(0.0))
        g.ctrl[slot, k] = real(0.0)
    sync()


@wp.func
def detect_fault(m: Model, sc: Scratch, slot: int, lane: int):
    """Record whether anything that the step returns is not finite."""
    if lane == 0:
        total = real(0.0)
        for k in range(m.nq):
            total += real(0.0) * sc.q[slot, m.substeps, k]
        for k in range(m.nv):
            total += real(0.0) * sc.v[slot, m.substeps, k]
        for s in range(m.substeps):
            for c in range(m.nc):
                total += real(0.0) * (
                    wp.dot(sc.impulse[slot, s, c], sc.impulse[slot, s, c])
                    + sc.normal_impulse[slot, s, c]
                )
        fault = int(0)
        if not wp.isfinite(total):
            fault = 1
        sc.fault[slot] = fault
    sync()


@wp.func
def store_world(
    m: Model, sc: Scratch, slot: int, x: Values, w: int, lane: int, lanes: int
):
    """Write the outputs of world ``w``: a faulty world stays where it was."""
    good = sc.fault[slot] == 0
    for k in range(lane, m.nq, lanes):
        x.q_new[w, k] = wp.where(good, sc.q[slot, m.substeps, k], x.q[w, k])
    for k in range(lane, m.nv, lanes):
        x.v_new[w, k] = wp.where(good, sc.v[slot, m.substeps, k], x.v[w, k])
    for i in range(lane, m.nb, lanes):
        linear = vec3()
        angular = vec3()
        normal = real(0.0)
        for s in range(m.substeps):
            for c in range(m.contact_start[i + 1], m.contact_start[i + 2]):
                linear += sc.impulse[slot, s, c]
                angular += sc.angular_impulse[slot, s, c]
                normal += sc.normal_impulse[slot, s, c]
        for j in range(3):
            x.impulse[w, i, j] = wp.where(good, linear[j], real(0.0))
            x.impulse[w, i, 3 + j] = wp.where(good, angular[j], real(0.0))
        x.normal_impulse[w, i] = wp.where(good, normal, real(0.0))
    if lane == 0:
        x.fault[w] = real(sc.fault[slot])


@wp.func
def seed_world(
    m: Model, sc: Scratch, g: Scratch, slot: int, x_bar: Values, w: int,
    lane: int, lanes: int,
):
    """Start the reverse pass: the caller's adjoints of the outputs."""
    good = real(1 - sc.fault[slot])
    for k in range(lane, m.nq, lanes):
        g.q[slot, m.substeps, k] = good * x_bar.q_new[w, k]
    for k in range(lane, m.nv, lanes):
        g.v[slot, m.substeps, k] = good * x_bar.v_new[w, k]
    for c in range(lane, m.nc, lanes):
        i = m.contact_body[c] - 1
        linear = vec3(
            x_bar.impulse[w, i, 0], x_bar.impulse[w, i, 1], x_bar.impulse[w, i, 2]
        )
        angular = vec3(
            x_bar.impulse[w, i, 3], x_bar.impulse[w, i, 4], x_bar.impulse[w, i, 5]
        )
        for s in range(m.substeps):
            g.impulse[slot, s, c] = good * linear
            g.angular_impulse[slot, s, c] = good * angular
            g.normal_impulse[slot, s, c] = good * x_bar.normal_impulse[w, i]
    sync()


@wp.func_grad(seed_world)
def adj_seed_world(
    m: Model, sc: Scratch, g: Scratch, slot: int, x_bar: Values, w: int,
    lane: int, lanes: int,
):
    """Nothing: seeding is not part of the step."""
    sync()


@wp.func_grad(detect_fault)
def adj_detect_fault(m: Model, sc: Scratch, slot: int, lane: int):
    """Nothing: a fault has no gradient."""
    sync()
