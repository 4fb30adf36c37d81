"""Moving a pack of worlds between the caller's arrays and the scratch, with adjoints.

The arrays hold one contiguous row per world: its fields are in :mod:`.rows`.
"""

import warp as wp

from . import block, part, plain, real, scalar, stage, sync, width
from .cpp.algebra import component
from .cpp.memory import constant, load, read_input, store, write_output
from .cpp.numbers import beyond, choose
from .cpp.operators import add, mul  # noqa: F401
from .parameters import PARAMETRIC, load_parameters, return_parameters
from .readings import seed, seed_bodies, seed_vector, store_bodies
from .structs import Model, Offsets, Scratch, offsets_at

WIDTH = wp.constant(width)
# Ten radians in a substep of 10 ms: nothing that moves so fast is simulated any more.
MAX_SPEED = wp.constant(scalar(1000.0))


BLOCK = wp.constant(block)
# Worlds of a warp: all its threads have one lane.
WARP = wp.constant(32)


@wp.struct
class Pack:
    """The worlds that one thread computes, side by side, and its share of them."""

    first: int
    count: int  # at most WIDTH; 0 where a thread only keeps step with others
    slot: int
    column: int  # of the scratch
    lane: int


@wp.func
def pack_at(tid: int, first: int, worlds: int, slot_stride: int, lanes: int):
    """Pack and lane of a thread, in a launch on ``worlds`` worlds from ``first`` on.

    On a GPU the threads of a block are its worlds by lanes. A block is full: threads
    beyond the last world repeat it, and write nothing.
    """
    pack = Pack()
    pack.slot = 0
    n = tid
    if WIDTH == 1:
        side = wp.min(WARP, BLOCK // lanes)
        own = tid // (side * lanes)
        thread = tid - own * side * lanes
        pack.lane = thread // side
        n = own * side + thread - pack.lane * side
        pack.first = first + wp.min(n, worlds - 1)
    else:
        pack.lane = 0
        pack.first = first + n * WIDTH
    pack.count = wp.min(WIDTH, wp.max(worlds - n * WIDTH, 0))
    pack.column = n * WIDTH * slot_stride
    return pack


@part
def load_world(
    m: Model,
    sc: Scratch,
    g: Scratch,
    offsets: Offsets,
    pack: Pack,
    x: wp.array[scalar],
    x_bar: wp.array[scalar],
    lane: int,
    lanes: int,
):
    """Copy the inputs of a pack into its slot, from ``offsets`` on.

    Reads: m.nq, m.nv, m.nu, m.inputs, sc.ctrl, x.
    Writes: sc.q, sc.v, sc.ctrl, sc.parameter.
    """
    size = m.inputs.size
    at = pack.first * size
    q = at + m.inputs.q
    v = at + m.inputs.v
    control = at + m.inputs.control
    for k in range(lane, m.nq, lanes):
        store(sc.q, offsets.q + k, read_input(x, q + k, size, pack.count))
    for k in range(lane, m.nv, lanes):
        store(sc.v, offsets.v + k, read_input(x, v + k, size, pack.count))
    for k in range(lane, m.nu, lanes):
        store(sc.ctrl, offsets.ctrl + k, read_input(x, control + k, size, pack.count))
    if PARAMETRIC:
        load_parameters(m, sc, offsets, x, at, pack.count, lane, lanes)
    sync(lane)


@wp.func_grad(load_world)
def adj_load_world(
    m: Model,
    sc: Scratch,
    g: Scratch,
    offsets: Offsets,
    pack: Pack,
    x: wp.array[scalar],
    x_bar: wp.array[scalar],
    lane: int,
    lanes: int,
):
    """Hand the adjoints of the inputs to the caller; exactly 0 for a faulty world.

    Reads: m.nq, m.nv, m.nu, m.inputs, sc.fault, g.q, g.v, g.ctrl, g.parameter, x.
    Writes: g.q, g.v, g.ctrl, g.parameter, x_bar.
    """
    sync(lane)
    size = m.inputs.size
    at = pack.first * size
    q = at + m.inputs.q
    v = at + m.inputs.v
    control = at + m.inputs.control
    fault = load(sc.fault, pack.slot)
    if PARAMETRIC:
        return_parameters(m, g, offsets, x, x_bar, at, pack.count, fault, lane, lanes)
    for k in range(lane, m.nq, lanes):
        value = choose(fault, real(), load(g.q, offsets.q + k))
        write_output(x_bar, q + k, size, pack.count, value)
        store(g.q, offsets.q + k, real())
    for k in range(lane, m.nv, lanes):
        value = choose(fault, real(), load(g.v, offsets.v + k))
        write_output(x_bar, v + k, size, pack.count, value)
        store(g.v, offsets.v + k, real())
    for k in range(lane, m.nu, lanes):
        value = choose(fault, real(), load(g.ctrl, offsets.ctrl + k))
        write_output(x_bar, control + k, size, pack.count, value)
        store(g.ctrl, offsets.ctrl + k, real())


@plain
def impulses_wrong(m: Model, sc: Scratch, slot: int, c: int):
    """Record whether the impulses of contact ``c`` are finite: 0, else not a number.

    Reads: m.nc, m.substeps, sc.impulse, sc.angular_impulse, sc.normal_impulse.
    Writes: sc.wrong.
    """
    # zero times a finite number is zero, anything else is not a number
    zero = scalar(0.0)
    total = real()
    for s in range(m.substeps):
        report = offsets_at(m, slot, 0, s, 0).report
        impulse = load(sc.impulse, report + c)
        angular = load(sc.angular_impulse, report + c)
        for j in range(3):
            total = total + zero * component(impulse, j)
            total = total + zero * component(angular, j)
        total = total + zero * load(sc.normal_impulse, report + c)
    store(sc.wrong, slot * m.nc + c, total)


@plain
def detect_fault(m: Model, sc: Scratch, pack: Pack, lane: int, lanes: int):
    """Record where a number is not finite, or a speed out of bounds.

    Reads: m.nq, m.nv, m.nc, m.substeps, sc.q, sc.v, sc.wrong.
    Writes: sc.fault, sc.lost.
    """
    for c in range(lane, m.nc, lanes):
        impulses_wrong(m, sc, pack.slot, c)
    sync(lane)
    if lane == 0:
        zero = scalar(0.0)
        total = real()
        start = offsets_at(m, pack.slot, 0, 0, 0)
        for k in range(m.nq):
            total = total + zero * load(sc.q, start.q + k)
        for k in range(m.nv):
            total = total + zero * load(sc.v, start.v + k)
        store(sc.lost, pack.slot, beyond(total, scalar(1.0)))
        end = offsets_at(m, pack.slot, 0, m.substeps, 0)
        for k in range(m.nq):
            total = total + zero * load(sc.q, end.q + k)
        for k in range(m.nv):
            total = total + zero * load(sc.v, end.v + k)
        for c in range(m.nc):
            total = total + load(sc.wrong, pack.slot * m.nc + c)
        fault = beyond(total, scalar(1.0))
        for k in range(m.nv):
            fault = fault + beyond(load(sc.v, end.v + k), MAX_SPEED)
        store(sc.fault, pack.slot, beyond(fault, scalar(0.5)))
    sync(lane)


@wp.func_grad(detect_fault)
def adj_detect_fault(m: Model, sc: Scratch, pack: Pack, lane: int, lanes: int):
    """Nothing: a fault has no gradient."""
    sync(lane)


@stage
def freeze_faulty(
    m: Model,
    sc: Scratch,
    pack: Pack,
    x: wp.array[scalar],
    end: Offsets,
    offsets: Offsets,
    lane: int,
    lanes: int,
):
    """The returned state: a faulty world stays where it was, or at rest.

    Reads: m.nq, m.nv, m.rest_q, m.inputs, sc.q, sc.v, sc.fault, sc.lost, x.
    Writes: sc.q, sc.v.
    """
    fault = load(sc.fault, pack.slot)
    lost = load(sc.lost, pack.slot)
    size = m.inputs.size
    q = pack.first * size + m.inputs.q
    v = pack.first * size + m.inputs.v
    for k in range(lane, m.nq, lanes):
        before = read_input(x, q + k, size, pack.count)
        stay = choose(lost, constant(m.rest_q, k), before)
        store(sc.q, offsets.q + k, choose(fault, stay, load(sc.q, end.q + k)))
    for k in range(lane, m.nv, lanes):
        stay = choose(lost, real(), read_input(x, v + k, size, pack.count))
        store(sc.v, offsets.v + k, choose(fault, stay, load(sc.v, end.v + k)))


@wp.func
def store_world(
    m: Model,
    sc: Scratch,
    offsets: Offsets,
    pack: Pack,
    y: wp.array[scalar],
    lane: int,
    lanes: int,
):
    """Write the outputs of a pack; impulses are zero at a fault.

    Reads: m.nb, m.nq, m.nv, m.reports_bodies, m.nf, m.outputs, m.reported, sc.q,
        sc.v, sc.fault, sc.pose, sc.twist_w, sc.body_impulse,
        sc.body_angular_impulse, sc.body_normal_impulse, sc.position, sc.com,
        sc.com_velocity, sc.torso_xy, sc.foot_contact, sc.smooth_foot_contact.
    Writes: y.
    """
    fault = load(sc.fault, pack.slot)
    count = pack.count
    size = m.outputs.size
    at = pack.first * size
    for k in range(lane, m.nq, lanes):
        write_output(y, at + m.outputs.q + k, size, count, load(sc.q, offsets.q + k))
    for k in range(lane, m.nv, lanes):
        write_output(y, at + m.outputs.v + k, size, count, load(sc.v, offsets.v + k))
    for i in range(lane, m.nb, lanes):
        linear = load(sc.body_impulse, offsets.reading + i + 1)
        angular = load(sc.body_angular_impulse, offsets.reading + i + 1)
        normal = load(sc.body_normal_impulse, offsets.reading + i + 1)
        impulse = at + m.outputs.impulse + 6 * i
        for j in range(3):
            value = choose(fault, real(), component(linear, j))
            write_output(y, impulse + j, size, count, value)
            value = choose(fault, real(), component(angular, j))
            write_output(y, impulse + 3 + j, size, count, value)
        value = choose(fault, real(), normal)
        write_output(y, at + m.outputs.normal_impulse + i, size, count, value)
    if lane == 0:
        write_output(y, at + m.outputs.fault, size, count, fault)
    for f in range(lane, m.nf, lanes):
        value = load(sc.foot_contact, pack.slot * m.nf + f)
        write_output(y, at + m.outputs.feet_contact + f, size, count, value)
        value = load(sc.smooth_foot_contact, pack.slot * m.nf + f)
        write_output(y, at + m.outputs.smooth_feet_contact + f, size, count, value)
    for k in range(lane, 2, lanes):
        value = load(sc.torso_xy, 2 * pack.slot + k)
        write_output(y, at + m.outputs.torso_xy + k, size, count, value)
    if m.reports_bodies == 1:
        store_bodies(m, sc, offsets, y, m.reported, at, size, count, lane, lanes)


@part
def seed_world(
    m: Model,
    sc: Scratch,
    g: Scratch,
    offsets: Offsets,
    pack: Pack,
    y_bar: wp.array[scalar],
    lane: int,
    lanes: int,
):
    """Start the reverse pass: the caller's adjoints of the outputs; 0 at a fault.

    Reads: m.nb, m.nq, m.nv, m.reports_bodies, m.nf, m.outputs, m.reported,
        sc.fault, y_bar.
    Writes: g.q, g.v, g.pose, g.twist_w, g.body_impulse, g.body_angular_impulse,
        g.body_normal_impulse, g.position, g.com, g.com_velocity, g.torso_xy,
        g.smooth_foot_contact.
    """
    fault = load(sc.fault, pack.slot)
    count = pack.count
    size = m.outputs.size
    at = pack.first * size
    for k in range(lane, m.nq, lanes):
        value = seed(fault, y_bar, at + m.outputs.q + k, size, count)
        store(g.q, offsets.q + k, value)
    for k in range(lane, m.nv, lanes):
        value = seed(fault, y_bar, at + m.outputs.v + k, size, count)
        store(g.v, offsets.v + k, value)
    for i in range(lane, m.nb, lanes):
        impulse = at + m.outputs.impulse + 6 * i
        linear = seed_vector(fault, y_bar, impulse, size, count)
        angular = seed_vector(fault, y_bar, impulse + 3, size, count)
        normal = seed(fault, y_bar, at + m.outputs.normal_impulse + i, size, count)
        store(g.body_impulse, offsets.reading + i + 1, linear)
        store(g.body_angular_impulse, offsets.reading + i + 1, angular)
        store(g.body_normal_impulse, offsets.reading + i + 1, normal)
    for f in range(lane, m.nf, lanes):
        # the contact itself is a step: its gradient is 0
        value = seed(fault, y_bar, at + m.outputs.smooth_feet_contact + f, size, count)
        store(g.smooth_foot_contact, pack.slot * m.nf + f, value)
    for k in range(lane, 2, lanes):
        value = seed(fault, y_bar, at + m.outputs.torso_xy + k, size, count)
        store(g.torso_xy, 2 * pack.slot + k, value)
    if m.reports_bodies == 1:
        seed_bodies(
            m, g, offsets, fault, y_bar, m.reported, at, size, count, lane, lanes
        )
    sync(lane)


@wp.func_grad(seed_world)
def adj_seed_world(
    m: Model,
    sc: Scratch,
    g: Scratch,
    offsets: Offsets,
    pack: Pack,
    y_bar: wp.array[scalar],
    lane: int,
    lanes: int,
):
    """Nothing: seeding is not part of the step."""
    sync(lane)
