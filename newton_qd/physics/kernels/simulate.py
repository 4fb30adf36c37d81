"""The substeps of one control step: the order of the stages, and nothing else."""

import warp as wp

from . import stage, sync
from .contact import contact_corrector, contact_impulse, contact_predictor, contact_slip
from .dynamics import equation_row
from .factorization import solve
from .inertia import contact_inertia, rigid_inertia
from .integration import new_coordinates, new_velocity
from .kinematics import free_joint, hinge_joint, world_frame
from .memory import load
from .structs import Model, Row, Scratch, row_at


@stage
def kinematics(m: Model, sc: Scratch, row: Row, lane: int, lanes: int):
    """Poses, twists and bias accelerations, root to leaves."""
    if lane == 0:
        world_frame(m, sc, row)
    sync()
    for level in range(m.body_levels):
        start = load(m.body_level_start, level)
        for p in range(start + lane, load(m.body_level_start, level + 1), lanes):
            i = load(m.body_level, p)
            if load(m.joint_kind, i) == 0:
                free_joint(m, sc, row, i)
            else:
                hinge_joint(m, sc, row, i)
        sync()


@stage
def composite(m: Model, sc: Scratch, row: Row, lane: int, lanes: int):
    """Rigid inertias and wrenches, leaves to root."""
    for n in range(m.body_levels):
        level = m.body_levels - 1 - n
        start = load(m.body_level_start, level)
        for p in range(start + lane, load(m.body_level_start, level + 1), lanes):
            rigid_inertia(m, sc, row, load(m.body_level, p))
        sync()


@stage
def linear_solve(m: Model, sc: Scratch, g: Scratch, row: Row, lane: int, lanes: int):
    """Contacts as added inertia, leaves to root; rows; solve; contact slip."""
    for n in range(m.body_levels):
        level = m.body_levels - 1 - n
        start = load(m.body_level_start, level)
        for p in range(start + lane, load(m.body_level_start, level + 1), lanes):
            contact_inertia(m, sc, row, load(m.body_level, p))
        sync()
    for k in range(lane, m.nv, lanes):
        equation_row(m, sc, row, k)
    sync()
    solve(m, sc, g, row, lane, lanes)
    for c in range(lane, m.nc, lanes):
        contact_slip(m, sc, row, c)
    sync()


@wp.func
def simulate(
    m: Model, sc: Scratch, g: Scratch, slot: int, keep: int, lane: int, lanes: int
):
    """All substeps of one world; ``keep`` as in ``row_at``."""
    for s in range(m.substeps):
        kinematics(m, sc, row_at(m, slot, keep, s, 0), lane, lanes)
        composite(m, sc, row_at(m, slot, keep, s, 0), lane, lanes)
        # predictor, then corrector
        for p in range(m.passes):
            row = row_at(m, slot, keep, s, p)
            for c in range(lane, m.nc, lanes):
                if p == 0:
                    contact_predictor(m, sc, row, c)
                else:
                    contact_corrector(m, sc, row, c)
            sync()
            linear_solve(m, sc, g, row, lane, lanes)
        last = row_at(m, slot, keep, s, m.passes - 1)
        for k in range(lane, m.nv, lanes):
            new_velocity(sc, last, k)
        for c in range(lane, m.nc, lanes):
            contact_impulse(sc, last, c)
        sync()
        for i in range(1 + lane, m.nb + 1, lanes):
            new_coordinates(m, sc, last, i)
        sync()
