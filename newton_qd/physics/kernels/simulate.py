"""One control step: the order of the stages, and nothing else."""

import warp as wp

from . import scalar, stage, sync
from .articulation import change_free, change_hinge, eliminate_hinge, gather, rest_world
from .contact import (
    contact_clip,
    contact_corrector,
    contact_impulse,
    contact_predictor,
    contact_slip,
)
from .cpp.memory import load
from .inertia import rigid_inertia
from .integration import mean_velocity, new_coordinates, new_velocity
from .kinematics import free_joint, hinge_joint, world_frame
from .readings import body_impulse, body_reading, foot_contact, torso_position
from .structs import Model, Row, Scratch, row_after, row_at
from .world import Pack, detect_fault, settle


@stage
def kinematics(m: Model, sc: Scratch, row: Row, lane: int, lanes: int):
    """Poses, twists and bias accelerations, root to leaves."""
    if lane == 0:
        world_frame(m, sc, row)
    sync(lane)
    for level in range(m.body_levels):
        start = load(m.body_level_start, level)
        for p in range(start + lane, load(m.body_level_start, level + 1), lanes):
            i = load(m.body_level, p)
            if load(m.joint_kind, i) == 0:
                free_joint(m, sc, row, i)
            else:
                hinge_joint(m, sc, row, i)
        sync(lane)


@stage
def linear_solve(m: Model, sc: Scratch, row: Row, lane: int, lanes: int):
    """Eliminate joints, leaves to root; velocity changes, root to leaves."""
    if lane == 0:
        rest_world(sc, row)
    for n in range(m.body_levels):
        level = m.body_levels - 1 - n
        start = load(m.body_level_start, level)
        for p in range(start + lane, load(m.body_level_start, level + 1), lanes):
            i = load(m.body_level, p)
            gather(m, sc, row, i)
            if load(m.joint_kind, i) != 0:
                eliminate_hinge(m, sc, row, i)
        sync(lane)
    for level in range(m.body_levels):
        start = load(m.body_level_start, level)
        for p in range(start + lane, load(m.body_level_start, level + 1), lanes):
            i = load(m.body_level, p)
            if load(m.joint_kind, i) == 0:
                change_free(m, sc, row, i)
            else:
                change_hinge(m, sc, row, i)
        sync(lane)
    for c in range(lane, m.nc, lanes):
        contact_slip(m, sc, row, c)
    sync(lane)


@stage
def substep(
    m: Model,
    sc: Scratch,
    slot: int,
    keep: int,
    s: int,
    trial: int,
    lane: int,
    lanes: int,
):
    """A trial of substep ``s`` from its kinematics on; ``keep`` as in ``row_at``."""
    start = trial * m.passes
    first = row_at(m, slot, keep, s, start)
    for i in range(1 + lane, m.nb + 1, lanes):
        rigid_inertia(m, sc, first, i)
    # predictor, then correctors
    for p in range(start, start + m.passes):
        row = row_at(m, slot, keep, s, p)
        for c in range(lane, m.nc, lanes):
            if p == 0:
                contact_predictor(m, sc, row, c)
            else:
                if p == 1:
                    contact_clip(m, sc, row, c)
                contact_corrector(m, sc, row, c, p)
        sync(lane)
        linear_solve(m, sc, row, lane, lanes)
    last = row_at(m, slot, keep, s, start + m.passes - 1)
    if trial < m.trials - 1:
        ahead = row_at(m, slot, keep, s, start + m.passes)
        for k in range(lane, m.nv, lanes):
            mean_velocity(sc, last, ahead, k)
        sync(lane)
    else:
        for k in range(lane, m.nv, lanes):
            new_velocity(sc, last, k)
        for c in range(lane, m.nc, lanes):
            contact_impulse(sc, last, c)
        sync(lane)
        for i in range(1 + lane, m.nb + 1, lanes):
            new_coordinates(m, sc, last, i)
        sync(lane)


@wp.func
def simulate(
    m: Model,
    sc: Scratch,
    pack: Pack,
    x: wp.array[scalar],
    keep: int,
    lane: int,
    lanes: int,
):
    """All substeps of a pack, then the returned state and what is read from it."""
    slot = pack.slot
    for n in range(m.substeps * m.trials + 1):
        # the kinematics of the returned state are those of a last turn: written
        # twice, a GPU's compiler takes twice as long
        s = n // m.trials
        trial = n - s * m.trials
        row = row_at(m, slot, keep, s + s // m.substeps, trial * m.passes)
        if s == m.substeps:
            detect_fault(m, sc, pack, x, lane)
            settle(m, sc, pack, x, row_at(m, slot, keep, s, 0), row, lane, lanes)
            sync(lane)
        if s < m.substeps or m.reports_bodies == 1 or m.torso_q < 0:
            kinematics(m, sc, row, lane, lanes)
        if s < m.substeps:
            substep(m, sc, slot, keep, s, trial, lane, lanes)
    read_out(m, sc, slot, row_after(m, slot, keep), lane, lanes)


@stage
def read_out(m: Model, sc: Scratch, slot: int, row: Row, lane: int, lanes: int):
    """What is read from the returned state and from the substeps."""
    for i in range(1 + lane, m.nb + 1, lanes):
        body_impulse(m, sc, slot, row, i)
    sync(lane)
    for f in range(lane, m.nf, lanes):
        foot_contact(m, sc, slot, row, f)
    if m.reports_bodies == 1 or m.torso_q < 0:
        for i in range(1 + lane, m.nb + 1, lanes):
            body_reading(m, sc, row, i)
        sync(lane)
    if lane == 0:
        torso_position(m, sc, slot, row)
    sync(lane)
