"""One control step: the order of the stages, and nothing else."""

import warp as wp

from . import part, scalar, stage, sync
from .contact import (
    contact_corrector,
    contact_given,
    contact_impulse,
    contact_predictor,
)
from .inertia import bias_wrench, rigid_inertia
from .integration import mean_velocity, new_coordinates, new_velocity
from .kinematics import kinematics
from .readings import body_impulse, body_reading, foot_contact, torso_position
from .solve import linear_solve
from .structs import Model, Offsets, Scratch, offsets_after, offsets_at, offsets_in
from .world import Pack, detect_fault, freeze_faulty


@stage
def substep(
    m: Model,
    sc: Scratch,
    slot: int,
    keep: int,
    s: int,
    iteration: int,
    lane: int,
    lanes: int,
):
    """An iteration of substep ``s``, once its kinematics are there.

    ``keep`` is as in ``offsets_at``.

    Reads: m.nb, m.nv, m.nc, m.iterations, m.solves, m.given.
    """
    start = iteration * m.solves
    first = offsets_in(m, slot, keep, s, iteration, start)
    # lanes with one more contact have no more bodies
    for i in range(lanes - lane, m.nb + 1, lanes):
        if iteration == 0:
            rigid_inertia(m, sc, first, i)
        bias_wrench(m, sc, first, i)
    # predictor, then correctors; a lane has the same contacts in all of them
    for p in range(start, start + m.solves):
        offsets = offsets_in(m, slot, keep, s, iteration, p)
        for c in range(lane, m.nc, lanes):
            if p == 0:
                contact_predictor(m, sc, offsets, c)
            else:
                if p < m.given:
                    contact_corrector(m, sc, offsets, c)
                else:
                    contact_given(m, sc, offsets, c, p)
        linear_solve(m, sc, offsets, lane, lanes)
    last = offsets_in(m, slot, keep, s, iteration, start + m.solves - 1)
    if iteration < m.iterations - 1:
        ahead = offsets_in(m, slot, keep, s, iteration + 1, start + m.solves)
        for k in range(lanes - 1 - lane, m.nv, lanes):
            mean_velocity(sc, last, ahead, k)
        sync(lane)
    else:
        for k in range(lanes - 1 - lane, m.nv, lanes):
            new_velocity(sc, last, k)
        for c in range(lane, m.nc, lanes):
            contact_impulse(sc, last, c)
        sync(lane)
        for i in range(1 + lane, m.nb + 1, lanes):
            new_coordinates(m, sc, last, i)
        sync(lane)


@part
def simulate(
    m: Model,
    sc: Scratch,
    pack: Pack,
    x: wp.array[scalar],
    keep: int,
    lane: int,
    lanes: int,
):
    """All substeps of a pack, then the returned state and what is read from it.

    Reads: m.substeps, m.iterations, m.solves, m.reports_bodies, m.torso_q.
    """
    slot = pack.slot
    for n in range(m.substeps * m.iterations + 1):
        # the kinematics of the returned state are those of a last turn: written
        # twice, a GPU's compiler takes twice as long
        s = n // m.iterations
        iteration = n - s * m.iterations
        ends = 1 - wp.min(m.substeps - s, 1)
        offsets = offsets_in(m, slot, keep, s + ends, iteration, iteration * m.solves)
        if s == m.substeps:
            detect_fault(m, sc, pack, lane, lanes)
            end = offsets_at(m, slot, keep, s, 0)
            freeze_faulty(m, sc, pack, x, end, offsets, lane, lanes)
            sync(lane)
        if s < m.substeps or m.reports_bodies == 1 or m.torso_q < 0:
            moved = wp.min(iteration, 1)
            kinematics(m, sc, offsets, moved, lane, lanes)
        if s < m.substeps:
            substep(m, sc, slot, keep, s, iteration, lane, lanes)
    read_out(m, sc, slot, offsets_after(m, slot, keep), lane, lanes)


@stage
def read_out(m: Model, sc: Scratch, slot: int, offsets: Offsets, lane: int, lanes: int):
    """What is read from the returned state and from the substeps.

    Reads: m.nb, m.reports_bodies, m.torso_q, m.nf.
    """
    for i in range(1 + lane, m.nb + 1, lanes):
        body_impulse(m, sc, slot, offsets, i)
    sync(lane)
    for f in range(lane, m.nf, lanes):
        foot_contact(m, sc, slot, offsets, f)
    if m.reports_bodies == 1 or m.torso_q < 0:
        for i in range(1 + lane, m.nb + 1, lanes):
            body_reading(m, sc, offsets, i)
        sync(lane)
    if lane == 0:
        torso_position(m, sc, slot, offsets)
    sync(lane)
