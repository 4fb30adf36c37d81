"""What is read from a state: where its bodies are, and which feet touch the ground.

Bodies are seen from the origin of the world: position and rotation of the link frame,
position and velocity of the centre of mass, and the angular velocity.
"""

import warp as wp

from newton_qd.physics.kinds import Tail

from . import real, scalar, stage, vec3
from .cpp.algebra import (
    component,
    cross,
    quaternion,
    rigid,
    transform_point,
    translation,
    vector,
)
from .cpp.memory import constant, load, read_input, store, write_output
from .cpp.numbers import above, choose, uniform
from .cpp.operators import add, div, mul, sub  # noqa: F401
from .cpp.smooth import algebraic, logistic
from .rows import Bodies
from .structs import Model, Offsets, Scratch, offsets_at


@stage
def body_reading(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Position of body ``i``, and position and velocity of its centre of mass.

    Reads: m.com, sc.pose, sc.twist_w, sc.twist_v.
    Writes: sc.position, sc.com, sc.com_velocity.
    """
    x = load(sc.pose, offsets.body + i)
    # the kernels work about O
    world = translation(load(sc.pose, offsets.body))
    com = transform_point(x, constant(m.com, i))
    velocity = load(sc.twist_v, offsets.motion + i) + cross(
        load(sc.twist_w, offsets.motion + i), com
    )
    store(sc.position, offsets.reading + i, translation(x) - world)
    store(sc.com, offsets.reading + i, com - world)
    store(sc.com_velocity, offsets.reading + i, velocity)


@wp.func
def store_bodies(
    m: Model,
    sc: Scratch,
    offsets: Offsets,
    y: wp.array[scalar],
    fields: Bodies,
    at: int,
    size: int,
    count: int,
    lane: int,
    lanes: int,
):
    """Write the bodies of a pack to ``fields`` of rows of ``size`` from ``at`` on.

    Reads: m.nb, sc.pose, sc.twist_w, sc.position, sc.com, sc.com_velocity.
    Writes: y.
    """
    for i in range(lane, m.nb, lanes):
        position = load(sc.position, offsets.reading + i + 1)
        pose = load(sc.pose, offsets.body + i + 1)
        com = load(sc.com, offsets.reading + i + 1)
        linear = load(sc.com_velocity, offsets.reading + i + 1)
        angular = load(sc.twist_w, offsets.motion + i + 1)
        turn = at + fields.rotation + 4 * i
        for j in range(4):
            write_output(y, turn + j, size, count, component(pose, 3 + j))
        for j in range(3):
            k = at + 3 * i + j
            write_output(y, k + fields.position, size, count, component(position, j))
            write_output(y, k + fields.com, size, count, component(com, j))
            value = component(linear, j)
            write_output(y, k + fields.linear_velocity, size, count, value)
            value = component(angular, j)
            write_output(y, k + fields.angular_velocity, size, count, value)


@wp.func
def seed_bodies(
    m: Model,
    g: Scratch,
    offsets: Offsets,
    fault: real,
    y_bar: wp.array[scalar],
    fields: Bodies,
    at: int,
    size: int,
    count: int,
    lane: int,
    lanes: int,
):
    """Start the reverse pass of the bodies; 0 for a faulty world.

    Reads: m.nb, y_bar.
    Writes: g.pose, g.twist_w, g.position, g.com, g.com_velocity.
    """
    for i in range(lane, m.nb, lanes):
        k = at + 3 * i
        r = at + fields.rotation + 4 * i
        turn = quaternion(
            seed(fault, y_bar, r, size, count),
            seed(fault, y_bar, r + 1, size, count),
            seed(fault, y_bar, r + 2, size, count),
            seed(fault, y_bar, r + 3, size, count),
        )
        position = seed_vector(fault, y_bar, k + fields.position, size, count)
        com = seed_vector(fault, y_bar, k + fields.com, size, count)
        linear = seed_vector(fault, y_bar, k + fields.linear_velocity, size, count)
        angular = seed_vector(fault, y_bar, k + fields.angular_velocity, size, count)
        store(g.position, offsets.reading + i + 1, position)
        store(g.pose, offsets.body + i + 1, rigid(vec3(), turn))
        store(g.com, offsets.reading + i + 1, com)
        store(g.com_velocity, offsets.reading + i + 1, linear)
        store(g.twist_w, offsets.motion + i + 1, angular)


@wp.func
def seed(fault: real, y_bar: wp.array[scalar], at: int, size: int, count: int) -> real:
    """Entry ``at`` of each row; 0 for a faulty world.

    Reads: y_bar.
    """
    return choose(fault, real(), read_input(y_bar, at, size, count))


@wp.func
def seed_vector(
    fault: real, y_bar: wp.array[scalar], at: int, size: int, count: int
) -> vec3:
    """Three entries from ``at`` on of each row; 0 for a faulty world.

    Reads: y_bar.
    """
    return vector(
        seed(fault, y_bar, at, size, count),
        seed(fault, y_bar, at + 1, size, count),
        seed(fault, y_bar, at + 2, size, count),
    )


@stage
def torso_position(m: Model, sc: Scratch, slot: int, offsets: Offsets):
    """Where the torso is on the ground: in the coordinates, if it moves freely.

    Reads: m.torso, m.torso_q, sc.q, sc.position.
    Writes: sc.torso_xy.
    """
    if m.torso_q >= 0:
        store(sc.torso_xy, 2 * slot, load(sc.q, offsets.q + m.torso_q))
        store(sc.torso_xy, 2 * slot + 1, load(sc.q, offsets.q + m.torso_q + 1))
    else:
        position = load(sc.position, offsets.reading + m.torso)
        store(sc.torso_xy, 2 * slot, component(position, 0))
        store(sc.torso_xy, 2 * slot + 1, component(position, 1))


@stage
def body_impulse(m: Model, sc: Scratch, slot: int, offsets: Offsets, i: int):
    """Contact impulses on body ``i`` over the control step.

    Reads: m.substeps, m.contact_start, sc.impulse, sc.angular_impulse,
        sc.normal_impulse.
    Writes: sc.body_impulse, sc.body_angular_impulse, sc.body_normal_impulse.
    """
    linear = vec3()
    angular = vec3()
    normal = real()
    for s in range(m.substeps):
        report = offsets_at(m, slot, 0, s, 0).report
        for c in range(load(m.contact_start, i), load(m.contact_start, i + 1)):
            linear = linear + load(sc.impulse, report + c)
            angular = angular + load(sc.angular_impulse, report + c)
            normal = normal + load(sc.normal_impulse, report + c)
    store(sc.body_impulse, offsets.reading + i, linear)
    store(sc.body_angular_impulse, offsets.reading + i, angular)
    store(sc.body_normal_impulse, offsets.reading + i, normal)


@stage
def foot_contact(m: Model, sc: Scratch, slot: int, offsets: Offsets, f: int):
    """Whether foot ``f`` carries weight, at once and as a smooth step.

    Reads: m.nf, m.foot, m.foot_weight, m.foot_fraction, m.foot_width, m.foot_tail,
        sc.fault, sc.body_normal_impulse.
    Writes: sc.foot_contact, sc.smooth_foot_contact.
    """
    impulse = load(sc.body_normal_impulse, offsets.reading + load(m.foot, f))
    fault = load(sc.fault, slot)
    share = choose(fault, real(), impulse) / uniform(m.foot_weight)
    at = slot * m.nf + f
    store(sc.foot_contact, at, above(share, m.foot_fraction))
    excess = (share - m.foot_fraction) / uniform(m.foot_width)
    if m.foot_tail == Tail.ALGEBRAIC:
        store(sc.smooth_foot_contact, at, algebraic(excess))
    else:
        store(sc.smooth_foot_contact, at, logistic(excess))
