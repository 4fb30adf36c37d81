"""Moving one world between the caller's arrays and the scratch, with adjoints.

The arrays hold one contiguous row per world. Inputs: q, v, ctrl. Outputs: q, v, the
contact impulse of each body (6), the normal impulse of each body, the fault.
"""

import warp as wp

from . import real, sync, vec3
from .memory import constant, load, store
from .structs import Model, Row, Scratch, row_at


@wp.func
def load_world(
    m: Model,
    sc: Scratch,
    g: Scratch,
    row: Row,
    slot: int,
    x: wp.array[real],
    x_bar: wp.array[real],
    w: int,
    lane: int,
    lanes: int,
):
    """Copy the inputs of world ``w`` into its slot, whose first row is ``row``."""
    at = w * (m.nq + m.nv + m.nu)
    for k in range(lane, m.nq, lanes):
        store(sc.q, row.q + k, constant(x, at + k))
    for k in range(lane, m.nv, lanes):
        store(sc.v, row.v + k, constant(x, at + m.nq + k))
    for k in range(lane, m.nu, lanes):
        store(sc.ctrl, row.ctrl + k, constant(x, at + m.nq + m.nv + k))
    sync(lane)


@wp.func_grad(load_world)
def adj_load_world(
    m: Model,
    sc: Scratch,
    g: Scratch,
    row: Row,
    slot: int,
    x: wp.array[real],
    x_bar: wp.array[real],
    w: int,
    lane: int,
    lanes: int,
):
    """Hand the adjoints of the inputs to the caller; exactly 0 for a faulty world."""
    sync(lane)
    at = w * (m.nq + m.nv + m.nu)
    good = sc.fault[slot] == 0
    for k in range(lane, m.nq, lanes):
        value = load(g.q, row.q + k)
        store(x_bar, at + k, wp.where(good, value, real(0.0)))
        store(g.q, row.q + k, real(0.0))
    for k in range(lane, m.nv, lanes):
        value = load(g.v, row.v + k)
        store(x_bar, at + m.nq + k, wp.where(good, value, real(0.0)))
        store(g.v, row.v + k, real(0.0))
    for k in range(lane, m.nu, lanes):
        value = load(g.ctrl, row.ctrl + k)
        store(x_bar, at + m.nq + m.nv + k, wp.where(good, value, real(0.0)))
        store(g.ctrl, row.ctrl + k, real(0.0))


@wp.func
def detect_fault(m: Model, sc: Scratch, slot: int, lane: int):
    """Record whether anything that the step returns is not finite."""
    if lane == 0:
        # zero times a finite number is zero, anything else is not a number
        total = real(0.0)
        end = row_at(m, slot, 0, m.substeps, 0)
        for k in range(m.nq):
            total += real(0.0) * load(sc.q, end.q + k)
        for k in range(m.nv):
            total += real(0.0) * load(sc.v, end.v + k)
        for s in range(m.substeps):
            report = row_at(m, slot, 0, s, 0).report
            for c in range(m.nc):
                j = load(sc.impulse, report + c)
                a = load(sc.angular_impulse, report + c)
                total += real(0.0) * load(sc.normal_impulse, report + c)
                total += real(0.0) * (j[0] + j[1] + j[2] + a[0] + a[1] + a[2])
        fault = int(0)
        if not wp.isfinite(total):
            fault = 1
        sc.fault[slot] = fault
    sync(lane)


@wp.func
def output_size(m: Model):
    """Length of a row of outputs."""
    return m.nq + m.nv + 7 * m.nb + 1


@wp.func
def store_state(
    m: Model,
    sc: Scratch,
    slot: int,
    x: wp.array[real],
    y: wp.array[real],
    w: int,
    lane: int,
    lanes: int,
):
    """Write q and v of world ``w``: a faulty world stays where it was, or at rest."""
    good = sc.fault[slot] == 0
    end = row_at(m, slot, 0, m.substeps, 0)
    start = w * (m.nq + m.nv + m.nu)
    at = w * output_size(m)
    whole = bool(True)
    for k in range(m.nq + m.nv):
        whole = whole and wp.isfinite(constant(x, start + k))
    for k in range(lane, m.nq, lanes):
        value = constant(x, start + k)
        if good:
            value = load(sc.q, end.q + k)
        elif not whole:
            value = constant(m.rest_q, k)
        store(y, at + k, value)
    for k in range(lane, m.nv, lanes):
        value = constant(x, start + m.nq + k)
        if good:
            value = load(sc.v, end.v + k)
        elif not whole:
            value = real(0.0)
        store(y, at + m.nq + k, value)


@wp.func
def store_impulses(
    m: Model,
    sc: Scratch,
    slot: int,
    y: wp.array[real],
    w: int,
    lane: int,
    lanes: int,
):
    """Write the contact impulses of world ``w``, zero at a fault, and the fault."""
    good = sc.fault[slot] == 0
    at = w * output_size(m) + m.nq + m.nv
    for i in range(lane, m.nb, lanes):
        linear = vec3()
        angular = vec3()
        normal = real(0.0)
        if good:
            for s in range(m.substeps):
                report = row_at(m, slot, 0, s, 0).report
                start = load(m.contact_start, i + 1)
                for c in range(start, load(m.contact_start, i + 2)):
                    linear += load(sc.impulse, report + c)
                    angular += load(sc.angular_impulse, report + c)
                    normal += load(sc.normal_impulse, report + c)
        for j in range(3):
            store(y, at + 6 * i + j, linear[j])
            store(y, at + 6 * i + 3 + j, angular[j])
        store(y, at + 6 * m.nb + i, normal)
    if lane == 0:
        store(y, at + 7 * m.nb, real(sc.fault[slot]))


@wp.func
def seed_world(
    m: Model,
    sc: Scratch,
    g: Scratch,
    slot: int,
    y_bar: wp.array[real],
    w: int,
    lane: int,
    lanes: int,
):
    """Start the reverse pass: the caller's adjoints of the outputs."""
    good = sc.fault[slot] == 0
    end = row_at(m, slot, 0, m.substeps, 0)
    at = w * output_size(m)
    for k in range(lane, m.nq, lanes):
        value = constant(y_bar, at + k)
        store(g.q, end.q + k, wp.where(good, value, real(0.0)))
    for k in range(lane, m.nv, lanes):
        value = constant(y_bar, at + m.nq + k)
        store(g.v, end.v + k, wp.where(good, value, real(0.0)))
    at += m.nq + m.nv
    for c in range(lane, m.nc, lanes):
        i = load(m.contact_body, c) - 1
        linear = vec3()
        angular = vec3()
        normal = real(0.0)
        if good:
            for j in range(3):
                linear[j] = constant(y_bar, at + 6 * i + j)
                angular[j] = constant(y_bar, at + 6 * i + 3 + j)
            normal = constant(y_bar, at + 6 * m.nb + i)
        for s in range(m.substeps):
            report = row_at(m, slot, 0, s, 0).report
            store(g.impulse, report + c, linear)
            store(g.angular_impulse, report + c, angular)
            store(g.normal_impulse, report + c, normal)
    sync(lane)


@wp.func_grad(seed_world)
def adj_seed_world(
    m: Model,
    sc: Scratch,
    g: Scratch,
    slot: int,
    y_bar: wp.array[real],
    w: int,
    lane: int,
    lanes: int,
):
    """Nothing: seeding is not part of the step."""
    sync(lane)


@wp.func_grad(detect_fault)
def adj_detect_fault(m: Model, sc: Scratch, slot: int, lane: int):
    """Nothing: a fault has no gradient."""
    sync(lane)
