"""Moving a pack of worlds between the caller's arrays and the scratch, with adjoints.

The arrays hold one contiguous row per world. Inputs: q, v, ctrl, and its parameters
where it has its own. Outputs: q, v, the contact impulse of each body (6), the normal
impulse of each body, the fault.
"""

import warp as wp

from . import real, scalar, sync, vec3, width
from .algebra import add, component, mul, vector
from .memory import constant, gather, load, scatter, store
from .numbers import beyond, choose
from .parameters import (
    PARAMETRIC,
    load_parameters,
    parameter_inputs,
    return_parameters,
)
from .structs import Model, Row, Scratch, row_at

WIDTH = wp.constant(width)
# Ten radians in a substep of 10 ms: nothing that moves so fast is simulated any more.
MAX_SPEED = wp.constant(scalar(1000.0))


@wp.struct
class Pack:
    """The worlds that one thread computes, side by side."""

    first: int
    count: int  # at most WIDTH
    slot: int


@wp.func
def pack_at(n: int, first: int, worlds: int, slot_stride: int):
    """Pack ``n`` of a launch on ``worlds`` worlds from ``first`` on."""
    pack = Pack()
    pack.first = first + n * WIDTH
    pack.count = wp.min(WIDTH, worlds - n * WIDTH)
    pack.slot = n * slot_stride
    return pack


@wp.func
def input_size(m: Model):
    """Length of a row of inputs."""
    return m.nq + m.nv + m.nu + parameter_inputs(m)


@wp.func
def output_size(m: Model):
    """Length of a row of outputs."""
    return m.nq + m.nv + 7 * m.nb + 1


@wp.func
def load_world(
    m: Model,
    sc: Scratch,
    g: Scratch,
    row: Row,
    pack: Pack,
    x: wp.array[scalar],
    x_bar: wp.array[scalar],
    lane: int,
    lanes: int,
):
    """Copy the inputs of a pack into its slot, whose first row is ``row``."""
    size = input_size(m)
    at = pack.first * size
    for k in range(lane, m.nq, lanes):
        store(sc.q, row.q + k, gather(x, at + k, size, pack.count))
    at += m.nq
    for k in range(lane, m.nv, lanes):
        store(sc.v, row.v + k, gather(x, at + k, size, pack.count))
    at += m.nv
    for k in range(lane, m.nu, lanes):
        store(sc.ctrl, row.ctrl + k, gather(x, at + k, size, pack.count))
    if PARAMETRIC:
        at += m.nu
        load_parameters(m, sc, row, x, at, size, pack.count, lane, lanes)
    sync(lane)


@wp.func_grad(load_world)
def adj_load_world(
    m: Model,
    sc: Scratch,
    g: Scratch,
    row: Row,
    pack: Pack,
    x: wp.array[scalar],
    x_bar: wp.array[scalar],
    lane: int,
    lanes: int,
):
    """Hand the adjoints of the inputs to the caller; exactly 0 for a faulty world."""
    sync(lane)
    size = input_size(m)
    at = pack.first * size
    fault = load(sc.fault, pack.slot)
    if PARAMETRIC:
        last = at + m.nq + m.nv + m.nu
        return_parameters(
            m, g, row, x, x_bar, last, size, pack.count, fault, lane, lanes
        )
    for k in range(lane, m.nq, lanes):
        value = choose(fault, real(), load(g.q, row.q + k))
        scatter(x_bar, at + k, size, pack.count, value)
        store(g.q, row.q + k, real())
    at += m.nq
    for k in range(lane, m.nv, lanes):
        value = choose(fault, real(), load(g.v, row.v + k))
        scatter(x_bar, at + k, size, pack.count, value)
        store(g.v, row.v + k, real())
    at += m.nv
    for k in range(lane, m.nu, lanes):
        value = choose(fault, real(), load(g.ctrl, row.ctrl + k))
        scatter(x_bar, at + k, size, pack.count, value)
        store(g.ctrl, row.ctrl + k, real())


@wp.func
def detect_fault(m: Model, sc: Scratch, slot: int, lane: int):
    """Record whether a number is not finite, or a speed out of bounds."""
    if lane == 0:
        # zero times a finite number is zero, anything else is not a number
        zero = scalar(0.0)
        total = real()
        end = row_at(m, slot, 0, m.substeps, 0)
        for k in range(m.nq):
            total = total + zero * load(sc.q, end.q + k)
        for k in range(m.nv):
            total = total + zero * load(sc.v, end.v + k)
        for s in range(m.substeps):
            report = row_at(m, slot, 0, s, 0).report
            for c in range(m.nc):
                impulse = load(sc.impulse, report + c)
                angular = load(sc.angular_impulse, report + c)
                for j in range(3):
                    total = total + zero * component(impulse, j)
                    total = total + zero * component(angular, j)
                total = total + zero * load(sc.normal_impulse, report + c)
        fault = beyond(total, scalar(1.0))
        for k in range(m.nv):
            fault = fault + beyond(load(sc.v, end.v + k), MAX_SPEED)
        store(sc.fault, slot, beyond(fault, scalar(0.5)))
    sync(lane)


@wp.func
def store_state(
    m: Model,
    sc: Scratch,
    pack: Pack,
    x: wp.array[scalar],
    y: wp.array[scalar],
    lane: int,
    lanes: int,
):
    """Write q and v of a pack: a faulty world stays where it was, or at rest."""
    fault = load(sc.fault, pack.slot)
    end = row_at(m, pack.slot, 0, m.substeps, 0)
    inputs = input_size(m)
    outputs = output_size(m)
    start = pack.first * inputs
    at = pack.first * outputs
    total = real()
    for k in range(m.nq + m.nv):
        total = total + scalar(0.0) * gather(x, start + k, inputs, pack.count)
    lost = beyond(total, scalar(1.0))
    for k in range(lane, m.nq, lanes):
        stay = choose(
            lost, constant(m.rest_q, k), gather(x, start + k, inputs, pack.count)
        )
        value = choose(fault, stay, load(sc.q, end.q + k))
        scatter(y, at + k, outputs, pack.count, value)
    start += m.nq
    at += m.nq
    for k in range(lane, m.nv, lanes):
        stay = choose(lost, real(), gather(x, start + k, inputs, pack.count))
        value = choose(fault, stay, load(sc.v, end.v + k))
        scatter(y, at + k, outputs, pack.count, value)


@wp.func
def store_impulses(
    m: Model,
    sc: Scratch,
    pack: Pack,
    y: wp.array[scalar],
    lane: int,
    lanes: int,
):
    """Write the contact impulses of a pack, zero at a fault, and the fault."""
    fault = load(sc.fault, pack.slot)
    size = output_size(m)
    at = pack.first * size + m.nq + m.nv
    for i in range(lane, m.nb, lanes):
        linear = vec3()
        angular = vec3()
        normal = real()
        for s in range(m.substeps):
            report = row_at(m, pack.slot, 0, s, 0).report
            start = load(m.contact_start, i + 1)
            for c in range(start, load(m.contact_start, i + 2)):
                linear = linear + load(sc.impulse, report + c)
                angular = angular + load(sc.angular_impulse, report + c)
                normal = normal + load(sc.normal_impulse, report + c)
        for j in range(3):
            value = choose(fault, real(), component(linear, j))
            scatter(y, at + 6 * i + j, size, pack.count, value)
            value = choose(fault, real(), component(angular, j))
            scatter(y, at + 6 * i + 3 + j, size, pack.count, value)
        value = choose(fault, real(), normal)
        scatter(y, at + 6 * m.nb + i, size, pack.count, value)
    if lane == 0:
        scatter(y, at + 7 * m.nb, size, pack.count, fault)


@wp.func
def seed_world(
    m: Model,
    sc: Scratch,
    g: Scratch,
    pack: Pack,
    y_bar: wp.array[scalar],
    lane: int,
    lanes: int,
):
    """Start the reverse pass: the caller's adjoints of the outputs."""
    fault = load(sc.fault, pack.slot)
    end = row_at(m, pack.slot, 0, m.substeps, 0)
    size = output_size(m)
    at = pack.first * size
    for k in range(lane, m.nq, lanes):
        value = gather(y_bar, at + k, size, pack.count)
        store(g.q, end.q + k, choose(fault, real(), value))
    at += m.nq
    for k in range(lane, m.nv, lanes):
        value = gather(y_bar, at + k, size, pack.count)
        store(g.v, end.v + k, choose(fault, real(), value))
    at += m.nv
    for c in range(lane, m.nc, lanes):
        i = load(m.contact_body, c) - 1
        linear = seed_vector(fault, y_bar, at + 6 * i, size, pack.count)
        angular = seed_vector(fault, y_bar, at + 6 * i + 3, size, pack.count)
        value = gather(y_bar, at + 6 * m.nb + i, size, pack.count)
        normal = choose(fault, real(), value)
        for s in range(m.substeps):
            report = row_at(m, pack.slot, 0, s, 0).report
            store(g.impulse, report + c, linear)
            store(g.angular_impulse, report + c, angular)
            store(g.normal_impulse, report + c, normal)
    sync(lane)


@wp.func
def seed_vector(
    fault: real, y_bar: wp.array[scalar], at: int, size: int, count: int
) -> vec3:
    """Three entries from ``at`` on of each row; 0 for a faulty world."""
    return vector(
        choose(fault, real(), gather(y_bar, at, size, count)),
        choose(fault, real(), gather(y_bar, at + 1, size, count)),
        choose(fault, real(), gather(y_bar, at + 2, size, count)),
    )


@wp.func_grad(seed_world)
def adj_seed_world(
    m: Model,
    sc: Scratch,
    g: Scratch,
    pack: Pack,
    y_bar: wp.array[scalar],
    lane: int,
    lanes: int,
):
    """Nothing: seeding is not part of the step."""
    sync(lane)


@wp.func_grad(detect_fault)
def adj_detect_fault(m: Model, sc: Scratch, slot: int, lane: int):
    """Nothing: a fault has no gradient."""
    sync(lane)
