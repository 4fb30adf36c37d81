"""Physical parameters: the model's, or where the package is parametric each world's.

A parametric row of inputs goes on, after the controls, with the parameters; what the
scratch holds of them for a pack is in ``Parameters``. Both are in :mod:`.rows`. The
scale of the gear is not kept: it scales the controls.

Otherwise nothing of this is compiled: the functions below are the model's constants.
"""

import warp as wp

from . import parametric, real, scalar, sync
from .cpp.memory import constant, load, read_input, store, write_output
from .cpp.numbers import choose, uniform
from .cpp.operators import add, mul, sub  # noqa: F401
from .structs import Model, Offsets, Scratch

PARAMETRIC = wp.constant(parametric)
# Scale of the stiffness of contacts in the place of 0: no digit of a motion shows it.
# At 0 itself, impulses and the width over which they are clipped are all 0, so that the
# gradient could not tell a contact that lifts off from one that stays.
LEAST_STIFFNESS = wp.constant(scalar(1.0e-20))


@wp.func
def gravity(m: Model, sc: Scratch, offsets: Offsets):
    """Downward acceleration [m/s^2].

    Reads: m.gravity, m.parameters, sc.parameter.
    """
    if PARAMETRIC:
        return load(sc.parameter, offsets.parameter + m.parameters.gravity)
    else:
        return uniform(m.gravity)


@wp.func
def friction(m: Model, sc: Scratch, offsets: Offsets):
    """Coulomb coefficient.

    Reads: m.friction, m.parameters, sc.parameter.
    """
    if PARAMETRIC:
        return load(sc.parameter, offsets.parameter + m.parameters.friction)
    else:
        return m.friction


@wp.func
def contact_stiffness(m: Model, sc: Scratch, offsets: Offsets):
    """Stiffness of a contact [N/m].

    Reads: m.contact_stiffness, m.parameters, sc.parameter.
    """
    if PARAMETRIC:
        return load(sc.parameter, offsets.parameter + m.parameters.contact_stiffness)
    else:
        return m.contact_stiffness


@wp.func
def total_mass(m: Model, sc: Scratch, offsets: Offsets):
    """Mass of the robot [kg].

    Reads: m.total_mass, m.parameters, sc.parameter.
    """
    if PARAMETRIC:
        return load(sc.parameter, offsets.parameter + m.parameters.total_mass)
    else:
        return uniform(m.total_mass)


@wp.func
def body_mass(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Mass of body ``i`` [kg].

    Reads: m.mass, m.parameters, sc.parameter.
    """
    if PARAMETRIC:
        return load(sc.parameter, offsets.parameter + m.parameters.mass + i - 1)
    else:
        return constant(m.mass, i)


@wp.func
def body_inertia(m: Model, sc: Scratch, offsets: Offsets, i: int):
    """Inertia of body ``i`` about its centre of mass, body axes [kg m^2].

    Reads: m.inertia, m.parameters, sc.parameter.
    """
    if PARAMETRIC:
        scales = offsets.parameter + m.parameters.inertia_scale
        scale = load(sc.parameter, scales + i - 1)
        return scale * constant(m.inertia, i)
    else:
        return constant(m.inertia, i)


@wp.func
def joint_damping(m: Model, sc: Scratch, offsets: Offsets, k: int):
    """Damping of dof ``k`` [N m s/rad or N s/m].

    Reads: m.damping, m.parameters, sc.parameter.
    """
    if PARAMETRIC:
        return load(sc.parameter, offsets.parameter + m.parameters.damping + k)
    else:
        return constant(m.damping, k)


@wp.func
def load_parameters(
    m: Model,
    sc: Scratch,
    offsets: Offsets,
    x: wp.array[scalar],
    at: int,
    count: int,
    lane: int,
    lanes: int,
):
    """Copy the parameters of a pack into its slot, once its controls are there.

    Reads: m.nb, m.nv, m.nu, m.total_mass, m.mass, m.damping, m.contact_stiffness,
        m.inputs, m.parameters, sc.ctrl, x.
    Writes: sc.ctrl, sc.parameter.

    Args:
        m: The model.
        sc: The scratch.
        offsets: Offsets of the first substep.
        x: Rows of inputs.
        at: Where the row of the pack's first world begins.
        count: Worlds of the pack.
        lane: This lane.
        lanes: Lanes of a pack.
    """
    one = scalar(1.0)
    size = m.inputs.size
    masses = at + m.inputs.mass_scale
    inertias = at + m.inputs.inertia_scale
    dampings = at + m.inputs.damping_scale
    gears = at + m.inputs.gear_scale
    out = offsets.parameter
    if lane == 0:
        value = read_input(x, at + m.inputs.gravity, size, count)
        store(sc.parameter, out + m.parameters.gravity, value)
        value = read_input(x, at + m.inputs.friction, size, count)
        store(sc.parameter, out + m.parameters.friction, value)
        scale = read_input(x, at + m.inputs.contact_stiffness_scale, size, count)
        scale = choose(scale, scale, uniform(LEAST_STIFFNESS))
        value = m.contact_stiffness * scale
        store(sc.parameter, out + m.parameters.contact_stiffness, value)
        # scales of 1 give the model's total mass to the last digit
        change = real()
        for i in range(m.nb):
            scale = read_input(x, masses + i, size, count)
            change = change + constant(m.mass, i + 1) * (scale - one)
        value = uniform(m.total_mass) + change
        store(sc.parameter, out + m.parameters.total_mass, value)
    for i in range(lane, m.nb, lanes):
        scale = read_input(x, masses + i, size, count)
        mass = scale * constant(m.mass, i + 1)
        store(sc.parameter, out + m.parameters.mass + i, mass)
        inertia = scale * read_input(x, inertias + i, size, count)
        store(sc.parameter, out + m.parameters.inertia_scale + i, inertia)
    for k in range(lane, m.nv, lanes):
        damping = read_input(x, dampings + k, size, count) * constant(m.damping, k)
        store(sc.parameter, out + m.parameters.damping + k, damping)
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
    at: int,
    count: int,
    fault: real,
    lane: int,
    lanes: int,
):
    """Adjoint of the gears, which scale the controls.

    Reads: m.nu, m.inputs, g.ctrl, x.
    Writes: g.ctrl, x_bar.
    """
    size = m.inputs.size
    controls = at + m.inputs.control
    gears = at + m.inputs.gear_scale
    for k in range(lane, m.nu, lanes):
        force = load(g.ctrl, offsets.ctrl + k)
        value = force * read_input(x, controls + k, size, count)
        write_output(x_bar, gears + k, size, count, choose(fault, real(), value))
        store(g.ctrl, offsets.ctrl + k, force * read_input(x, gears + k, size, count))


@wp.func
def return_one(
    m: Model,
    g: Scratch,
    x_bar: wp.array[scalar],
    held: int,
    given: int,
    count: int,
    fault: real,
):
    """Hand over and clear the adjoint of a single parameter.

    Reads: m.inputs, g.parameter.
    Writes: g.parameter, x_bar.
    """
    value = load(g.parameter, held)
    write_output(x_bar, given, m.inputs.size, count, choose(fault, real(), value))
    store(g.parameter, held, real())


@wp.func
def return_shared(
    m: Model,
    g: Scratch,
    offsets: Offsets,
    x_bar: wp.array[scalar],
    at: int,
    count: int,
    fault: real,
):
    """Adjoint of the parameters that a world has one of.

    Reads: m.contact_stiffness, m.inputs, m.parameters, g.parameter.
    Writes: g.parameter, x_bar.
    """
    held = offsets.parameter + m.parameters.contact_stiffness
    store(g.parameter, held, m.contact_stiffness * load(g.parameter, held))
    given = at + m.inputs.contact_stiffness_scale
    return_one(m, g, x_bar, held, given, count, fault)
    held = offsets.parameter + m.parameters.gravity
    return_one(m, g, x_bar, held, at + m.inputs.gravity, count, fault)
    held = offsets.parameter + m.parameters.friction
    return_one(m, g, x_bar, held, at + m.inputs.friction, count, fault)
    store(g.parameter, offsets.parameter + m.parameters.total_mass, real())


@wp.func
def return_parameters(
    m: Model,
    g: Scratch,
    offsets: Offsets,
    x: wp.array[scalar],
    x_bar: wp.array[scalar],
    at: int,
    count: int,
    fault: real,
    lane: int,
    lanes: int,
):
    """Adjoint of ``load_parameters``; leaves that of the controls as they came in.

    Reads: m.nb, m.nv, m.mass, m.damping, m.inputs, m.parameters, g.ctrl,
        g.parameter, x.
    Writes: g.ctrl, g.parameter, x_bar.

    Args:
        m: The model.
        g: Adjoint of the scratch.
        offsets: Offsets of the first substep.
        x: Rows of inputs.
        x_bar: Their adjoints, to write.
        at: Where the row of the pack's first world begins.
        count: Worlds of the pack.
        fault: Whether a world's gradient is 0.
        lane: This lane.
        lanes: Lanes of a pack.
    """
    zero = real()
    size = m.inputs.size
    masses = at + m.inputs.mass_scale
    inertias = at + m.inputs.inertia_scale
    dampings = at + m.inputs.damping_scale
    start = offsets.parameter
    total = load(g.parameter, start + m.parameters.total_mass)
    for i in range(lane, m.nb, lanes):
        held = start + m.parameters.mass + i
        kept = start + m.parameters.inertia_scale + i
        mass = load(g.parameter, held) + total
        inertia = load(g.parameter, kept)
        value = constant(m.mass, i + 1) * mass + inertia * read_input(
            x, inertias + i, size, count
        )
        write_output(x_bar, masses + i, size, count, choose(fault, zero, value))
        value = inertia * read_input(x, masses + i, size, count)
        write_output(x_bar, inertias + i, size, count, choose(fault, zero, value))
        store(g.parameter, held, zero)
        store(g.parameter, kept, zero)
    for k in range(lane, m.nv, lanes):
        held = start + m.parameters.damping + k
        value = load(g.parameter, held) * constant(m.damping, k)
        write_output(x_bar, dampings + k, size, count, choose(fault, zero, value))
        store(g.parameter, held, zero)
    return_gears(m, g, offsets, x, x_bar, at, count, fault, lane, lanes)
    # every lane has read the adjoint of the total mass
    sync(lane)
    if lane == 0:
        return_shared(m, g, offsets, x_bar, at, count, fault)
