"""Moving one world between the caller's arrays and the scratch, with adjoints."""

import warp as wp

from . import real, sync, vec3
from .memory import load, store
from .structs import Model, Row, Scratch, row_at


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
    m: Model,
    sc: Scratch,
    g: Scratch,
    row: Row,
    slot: int,
    x: Values,
    x_bar: Values,
    w: int,
    lane: int,
    lanes: int,
):
    """Copy the inputs of world ``w`` into its slot, whose first row is ``row``."""
    for k in range(lane, m.nq, lanes):
        store(sc.q, row.q + k, x.q[w, k])
    for k in range(lane, m.nv, lanes):
        store(sc.v, row.v + k, x.v[w, k])
    for k in range(lane, m.nu, lanes):
        store(sc.ctrl, row.ctrl + k, x.ctrl[w, k])
    sync()


@wp.func_grad(load_world)
def adj_load_world(
    m: Model,
    sc: Scratch,
    g: Scratch,
    row: Row,
    slot: int,
    x: Values,
    x_bar: Values,
    w: int,
    lane: int,
    lanes: int,
):
    """Hand the adjoints of the inputs to the caller; exactly 0 for a faulty world."""
    good = sc.fault[slot] == 0
    for k in range(lane, m.nq, lanes):
        x_bar.q[w, k] = wp.where(good, load(g.q, row.q + k), real(0.0))
        store(g.q, row.q + k, real(0.0))
    for k in range(lane, m.nv, lanes):
        x_bar.v[w, k] = wp.where(good, load(g.v, row.v + k), real(0.0))
        store(g.v, row.v + k, real(0.0))
    for k in range(lane, m.nu, lanes):
        x_bar.ctrl[w, k] = wp.where(good, load(g.ctrl, row.ctrl + k), real(0.0))
        store(g.ctrl, row.ctrl + k, real(0.0))
    sync()


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
    sync()


@wp.func
def store_world(
    m: Model, sc: Scratch, slot: int, x: Values, w: int, lane: int, lanes: int
):
    """Write the outputs of world ``w``: a faulty world stays where it was."""
    good = sc.fault[slot] == 0
    end = row_at(m, slot, 0, m.substeps, 0)
    for k in range(lane, m.nq, lanes):
        x.q_new[w, k] = wp.where(good, load(sc.q, end.q + k), x.q[w, k])
    for k in range(lane, m.nv, lanes):
        x.v_new[w, k] = wp.where(good, load(sc.v, end.v + k), x.v[w, k])
    for i in range(lane, m.nb, lanes):
        linear = vec3()
        angular = vec3()
        normal = real(0.0)
        for s in range(m.substeps):
            report = row_at(m, slot, 0, s, 0).report
            for c in range(m.contact_start[i + 1], m.contact_start[i + 2]):
                linear += load(sc.impulse, report + c)
                angular += load(sc.angular_impulse, report + c)
                normal += load(sc.normal_impulse, report + c)
        for j in range(3):
            x.impulse[w, i, j] = wp.where(good, linear[j], real(0.0))
            x.impulse[w, i, 3 + j] = wp.where(good, angular[j], real(0.0))
        x.normal_impulse[w, i] = wp.where(good, normal, real(0.0))
    if lane == 0:
        x.fault[w] = real(sc.fault[slot])


@wp.func
def seed_world(
    m: Model,
    sc: Scratch,
    g: Scratch,
    slot: int,
    x_bar: Values,
    w: int,
    lane: int,
    lanes: int,
):
    """Start the reverse pass: the caller's adjoints of the outputs."""
    good = sc.fault[slot] == 0
    end = row_at(m, slot, 0, m.substeps, 0)
    for k in range(lane, m.nq, lanes):
        store(g.q, end.q + k, wp.where(good, x_bar.q_new[w, k], real(0.0)))
    for k in range(lane, m.nv, lanes):
        store(g.v, end.v + k, wp.where(good, x_bar.v_new[w, k], real(0.0)))
    for c in range(lane, m.nc, lanes):
        i = m.contact_body[c] - 1
        linear = vec3()
        angular = vec3()
        normal = real(0.0)
        if good:
            for j in range(3):
                linear[j] = x_bar.impulse[w, i, j]
                angular[j] = x_bar.impulse[w, i, 3 + j]
            normal = x_bar.normal_impulse[w, i]
        for s in range(m.substeps):
            report = row_at(m, slot, 0, s, 0).report
            store(g.impulse, report + c, linear)
            store(g.angular_impulse, report + c, angular)
            store(g.normal_impulse, report + c, normal)
    sync()


@wp.func_grad(seed_world)
def adj_seed_world(
    m: Model,
    sc: Scratch,
    g: Scratch,
    slot: int,
    x_bar: Values,
    w: int,
    lane: int,
    lanes: int,
):
    """Nothing: seeding is not part of the step."""
    sync()


@wp.func_grad(detect_fault)
def adj_detect_fault(m: Model, sc: Scratch, slot: int, lane: int):
    """Nothing: a fault has no gradient."""
    sync()
