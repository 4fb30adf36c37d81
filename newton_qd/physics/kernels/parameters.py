"""Physical parameters: the model's, or where the package is parametric each world's.

A parametric row of inputs goes on, after the controls, with gravity, friction and the
scales of contact stiffness (1), mass (nb), inertia (nb), damping (nv) and gear (nu).
The scratch holds, for a pack: gravity, friction, contact stiffness and total mass, then
mass (nb), scale of inertia (nb) and damping (nv); the gear scales the controls.

Otherwise nothing of this is compiled: the functions below are the model's constants.
"""

import warp as wp

from . import parametric, real, scalar, sync
from .cpp.algebra import add, mul, sub
from .cpp.memory import constant, load, read_input, store, write_output
from .cpp.numbers import choose, uniform
from .structs import Model, Offsets, Scratch

PARAMETRIC = wp.constant(parametric)


@wp.func
def parameter_inputs(m: Model):
    """Length of a world's parameters in a row of inputs."""
    if PARAMETRIC:
        return 3 + 2 * m.nb + m.nv + m.nu
    else:
        return 0


@wp.func
def gravity(m: Model, sc: Scratch, offsets: Offsets):
    """Downward acceleration [m/s^2]."""
    if PARAMETRIC:
        return load(sc.parameter, offsets.parameter)
    else:
        return uniform(m.gravity)


@wp.func
def friction(m: Model, sc: Scratch, offsets: Offsets):
    """Coulomb coefficient."""
    if PARAMETRIC:
        return load(sc.parameter, offsets.parameter + 1)
    else:
        return m.friction


@wp.func
def contact_stiffness(m: Model, sc: Scratch, offsets: Offsets):
    """Stiffness of a contact [N/m]."""
    if PARAMETRIC:
        return load(sc.parameter, offsets.parameter + 2)
    else:
        return m.contact_stiffness


@wp.func
def total_mass(m: Model, sc: Scratch, offsets: Offsets):
    """Mass of the robot [kg]."""
    if PARAMETRIC:
        return load(sc.parameter, offsets.parameter + 3)
    else:
        return uniform(m.total_mass)


@wp.func
def body_mass(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Mass of body ``i`` [kg]."""
    if PARAMETRIC:
        return load(sc.parameter, offsets.parameter + 3 + i)
    else:
        return constant(m.mass, i)


@wp.func
def body_inertia(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Inertia of body ``i`` about its centre of mass, body axes [kg m^2]."""
    if PARAMETRIC:
        scale = load(sc.parameter, offsets.parameter + 3 + m.nb + i)
        return scale * constant(m.inertia, i)
    else:
        return constant(m.inertia, i)


@wp.func
def joint_damping(m: Model, sc: Scratch, offsets: Offsets, k: int):
    """Damping of dof ``k`` [N m s/rad or N s/m]."""
    if PARAMETRIC:
        return load(sc.parameter, offsets.parameter + 4 + 2 * m.nb + k)
    else:
        return constant(m.damping, k)


@wp.func
def load_parameters(
    m: Model,
    sc: Scratch,
    offsets: Offsets,
    x: wp.array[scalar],
    at: int,
    size: int,
    count: int,
    lane: int,
    lanes: int,
):
    """Copy the parameters of a pack into its slot, once its controls are there.

    Args:
        m: The model.
        sc: The scratch.
        offsets: Offsets of the first substep.
        x: Rows of inputs.
        at: Where the parameters of the pack's first world begin.
        size: Length of a row of inputs.
        count: Worlds of the pack.
        lane: This lane.
        lanes: Lanes of a pack.
    """
    one = scalar(1.0)
    out = offsets.parameter
    masses = at + 3
    inertias = masses + m.nb
    dampings = inertias + m.nb
    gears = dampings + m.nv
    if lane == 0:
        store(sc.parameter, out, read_input(x, at, size, count))
        store(sc.parameter, out + 1, read_input(x, at + 1, size, count))
        stiffness = m.contact_stiffness * read_input(x, at + 2, size, count)
        store(sc.parameter, out + 2, stiffness)
        # scales of 1 give the model's total mass to the last digit
        change = real()
        for i in range(m.nb):
            scale = read_input(x, masses + i, size, count)
            change = change + constant(m.mass, i + 1) * (scale - one)
        store(sc.parameter, out + 3, uniform(m.total_mass) + change)
    for i in range(lane, m.nb, lanes):
        scale = read_input(x, masses + i, size, count)
        store(sc.parameter, out + 4 + i, scale * constant(m.mass, i + 1))
        inertia = scale * read_input(x, inertias + i, size, count)
        store(sc.parameter, out + 4 + m.nb + i, inertia)
    for k in range(lane, m.nv, lanes):
        damping = read_input(x, dampings + k, size, count) * constant(m.damping, k)
        store(sc.parameter, out + 4 + 2 * m.nb + k, damping)
    for k in range(lane, m.nu, lanes):
        gear = read_input(x, gears + k, size, count)
        store(sc.ctrl, offsets.ctrl + k, gear * load(sc.ctrl, offsets.ctrl + k))


@wp.func
def return_gears(
    m: Model,
    g: Scratch,
    offsets: Offsets,
    x: wp.array[scalar],
    x_bar: wp.array[scalar],
    controls: int,
    gears: int,
    size: int,
    count: int,
    fault: real,
    lane: int,
    lanes: int,
):
    """Adjoint of the gears, which scale the controls; both are in ``x`` from there."""
    for k in range(lane, m.nu, lanes):
        force = load(g.ctrl, offsets.ctrl + k)
        value = force * read_input(x, controls + k, size, count)
        write_output(x_bar, gears + k, size, count, choose(fault, real(), value))
        store(g.ctrl, offsets.ctrl + k, force * read_input(x, gears + k, size, count))


@wp.func
def return_parameters(
    m: Model,
    g: Scratch,
    offsets: Offsets,
    x: wp.array[scalar],
    x_bar: wp.array[scalar],
    at: int,
    size: int,
    count: int,
    fault: real,
    lane: int,
    lanes: int,
):
    """Adjoint of ``load_parameters``; leaves that of the controls as they came in.

    Args:
        m: The model.
        g: Adjoint of the scratch.
        offsets: Offsets of the first substep.
        x: Rows of inputs.
        x_bar: Their adjoints, to write.
        at: Where the parameters of the pack's first world begin.
        size: Length of a row of inputs.
        count: Worlds of the pack.
        fault: Whether a world's gradient is 0.
        lane: This lane.
        lanes: Lanes of a pack.
    """
    zero = real()
    start = offsets.parameter
    masses = at + 3
    inertias = masses + m.nb
    dampings = inertias + m.nb
    gears = dampings + m.nv
    total = load(g.parameter, start + 3)
    for i in range(lane, m.nb, lanes):
        mass = load(g.parameter, start + 4 + i) + total
        inertia = load(g.parameter, start + 4 + m.nb + i)
        value = constant(m.mass, i + 1) * mass + inertia * read_input(
            x, inertias + i, size, count
        )
        write_output(x_bar, masses + i, size, count, choose(fault, zero, value))
        value = inertia * read_input(x, masses + i, size, count)
        write_output(x_bar, inertias + i, size, count, choose(fault, zero, value))
        store(g.parameter, start + 4 + i, zero)
        store(g.parameter, start + 4 + m.nb + i, zero)
    for k in range(lane, m.nv, lanes):
        value = load(g.parameter, start + 4 + 2 * m.nb + k) * constant(m.damping, k)
        write_output(x_bar, dampings + k, size, count, choose(fault, zero, value))
        store(g.parameter, start + 4 + 2 * m.nb + k, zero)
    return_gears(
        m, g, offsets, x, x_bar, at - m.nu, gears, size, count, fault, lane, lanes
    )
    # every lane has read the adjoint of the total mass
    sync(lane)
    if lane == 0:
        stiffness = m.contact_stiffness * load(g.parameter, start + 2)
        store(g.parameter, start + 2, stiffness)
        for k in range(3):
            value = load(g.parameter, start + k)
            write_output(x_bar, at + k, size, count, choose(fault, zero, value))
        for k in range(4):
            store(g.parameter, start + k, zero)
