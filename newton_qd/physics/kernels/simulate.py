"""The substeps of one control step: the order of the stages, and nothing else."""

import warp as wp

from . import sync
from .contact import contact_corrector, contact_impulse, contact_predictor, contact_slip
from .dynamics import equation_row
from .factorization import solve
from .inertia import contact_inertia, rigid_inertia
from .integration import new_coordinates, new_velocity
from .kinematics import free_joint, hinge_joint, world_frame
from .structs import Model, Scratch


@wp.func
def kinematics(m: Model, sc: Scratch, slot: int, s: int, lane: int, lanes: int):
    """Poses, twists and bias accelerations, root to leaves."""
    if lane == 0:
        world_frame(m, sc, slot, s)
    sync()
    for level in range(m.body_levels):
        for p in range(
            m.body_level_start[level] + lane, m.body_level_start[level + 1], lanes
        ):
            i = m.body_level[p]
            if m.joint_kind[i] == 0:
                free_joint(m, sc, slot, s, i)
            else:
                hinge_joint(m, sc, slot, s, i)
        sync()


@wp.func
def composite(m: Model, sc: Scratch, slot: int, s: int, lane: int, lanes: int):
    """Rigid inertias and wrenches, leaves to root."""
    for n in range(m.body_levels):
        level = m.body_levels - 1 - n
        for p in range(
            m.body_level_start[level] + lane, m.body_level_start[level + 1], lanes
        ):
            rigid_inertia(m, sc, slot, s, m.body_level[p])
        sync()


@wp.func
def linear_solve(
    m: Model,
    sc: Scratch,
    g: Scratch,
    slot: int,
    s: int,
    t: int,
    lane: int,
    lanes: int,
):
    """Contacts as added inertia, leaves to root; rows; solve; contact slip."""
    for n in range(m.body_levels):
        level = m.body_levels - 1 - n
        for p in range(
            m.body_level_start[level] + lane, m.body_level_start[level + 1], lanes
        ):
            contact_inertia(m, sc, slot, s, t, m.body_level[p])
        sync()
    for k in range(lane, m.nv, lanes):
        equation_row(m, sc, slot, s, t, k)
    sync()
    solve(m, sc, g, slot, t, lane, lanes)
    for c in range(lane, m.nc, lanes):
        contact_slip(m, sc, slot, s, t, c)
    sync()


linear_solve.skip_replay = True
kinematics.skip_replay = True
composite.skip_replay = True


@wp.func
def simulate(m: Model, sc: Scratch, g: Scratch, slot: int, lane: int, lanes: int):
    """All substeps of one world."""
    for s in range(m.substeps):
        kinematics(m, sc, slot, s, lane, lanes)
        for c in range(lane, m.nc, lanes):
            contact_predictor(m, sc, slot, s, c)
        composite(m, sc, slot, s, lane, lanes)
        linear_solve(m, sc, g, slot, s, 2 * s, lane, lanes)
        for c in range(lane, m.nc, lanes):
            contact_corrector(m, sc, slot, s, c)
        sync()
        linear_solve(m, sc, g, slot, s, 2 * s + 1, lane, lanes)
        for k in range(lane, m.nv, lanes):
            new_velocity(m, sc, slot, s, k)
        for c in range(lane, m.nc, lanes):
            contact_impulse(sc, slot, s, c)
        sync()
        for i in range(1 + lane, m.nb + 1, lanes):
            new_coordinates(m, sc, slot, s, i)
        sync()
