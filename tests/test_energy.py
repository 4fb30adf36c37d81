"""The energy of a world, against references of other kinds."""

from __future__ import annotations

import dataclasses
import functools

import jax
import numpy as np
import pytest
from energy_helpers import compressed, energy, ledger
from physics_helpers import order, penetration, report
from subjects import SUBJECTS, finer, motion, poses, subject

from newton_qd.physics import reference

pytestmark = pytest.mark.usefixtures("x64")


def test_compressed_is_the_integral_of_penetration() -> None:
    width = 0.02
    gaps = np.linspace(-3 * width, 2 * width, 5001)
    stored = np.asarray(compressed(gaps, width))
    assert (stored[gaps >= width] == 0).all()
    slope = np.gradient(stored, gaps, edge_order=2)
    step = gaps[1] - gaps[0]
    # the second derivative of x is 3 / (4 w) at most
    np.testing.assert_allclose(slope, -penetration(gaps, width), atol=step**2 / width)


@pytest.mark.parametrize("name", SUBJECTS)
def test_kinetic_energy_and_gravity(name: str) -> None:
    """Against the mass matrix and the heights of an independent reference."""
    system = subject(name).system
    rng = np.random.default_rng(0)
    parts = jax.jit(functools.partial(energy, system))
    for q in poses(system, 3):
        v = rng.normal(size=system.nv)
        found = parts(q, v)
        kinetic = 0.5 * v @ reference.mass_matrix(system, q) @ v
        assert float(found.kinetic) == pytest.approx(kinetic, rel=1e-10)
        heights = [
            reference.compose(frame, np.append(com, [0, 0, 0, 1.0]))[2]
            for frame, com in zip(
                reference.body_frames(system, q), system.com, strict=True
            )
        ]
        weight = system.robot.gravity * system.mass @ np.array(heights)
        assert float(found.gravity) == pytest.approx(weight, rel=1e-10, abs=1e-10)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("halfcheetah", marks=pytest.mark.slow),
        pytest.param("hexapod", marks=pytest.mark.slow),
        "reacherangle",
    ],
)
def test_energy_is_the_work_of_the_motors(name: str) -> None:
    """Without friction and damping, up to what the scheme loses: of first order in h.

    The robots touch the ground and their limits, and halfcheetah's feet meet.
    """
    one = subject(name)
    still = one.system
    material = dataclasses.replace(
        still.robot.material, friction=0.0, dissipation=0.0, limit_dissipation=0.0
    )
    robot = dataclasses.replace(still.robot, material=material)
    free = dataclasses.replace(still, robot=robot, damping=np.zeros(still.nv))
    worlds, steps = 4, round(0.1 / robot.dt)
    q, v = one.reset(worlds)
    rng = np.random.default_rng(0)
    v = v + rng.normal(size=v.shape)
    actions = motion("noise", rng, steps, worlds, one.actions, robot.dt)
    factors = np.array([128, 256, 512])
    lost, exchanged = [], 0.0
    for factor in factors:
        found = ledger(finer(free, int(factor)), one.control)(q, v, actions)
        lost.append(np.abs(found.gains().sum(axis=0)).mean())
        exchanged = np.abs(found.work).sum(axis=0).mean()
        stored = np.asarray(found.energy.elastic).max(axis=0).mean()
        report("lost, work, elastic [J]", (lost[-1], exchanged, stored))
    slope = order(1.0 / factors, np.array(lost))
    report("order", slope)
    assert slope == pytest.approx(1.0, abs=0.15)
    assert lost[-1] < 0.05 * exchanged
