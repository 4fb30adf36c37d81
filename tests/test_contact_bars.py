"""What contact holds: energy, convergence, friction and gradients.

``benchmarks/contact.py`` prints the figures that these tests bound, and those of the
robots that do not hold the bounds yet (docs/verification.md).
"""

from __future__ import annotations

import numpy as np
import pytest
from contact_measures import busy as busy_states
from contact_measures import (
    drift,
    errors,
    faults,
    friction_ratios,
    gradient_norms,
    touching_acrobot,
)
from energy_helpers import driven, dropped, excess, fast_feet, judge
from physics_helpers import report
from subjects import ACTIONS, subject

import newton_qd

pytestmark = [pytest.mark.usefixtures("x64"), pytest.mark.slow]

WALKING = ["ant", "fetch", "hopper", "walker2d", "humanoid"]


# Energy


def test_fast_feet_lose_energy() -> None:
    """In every substep of two control steps; kinetic 87 J at first."""
    found = fast_feet(subject("halfcheetah").system)
    assert float(found.energy.kinetic[0, 0]) == pytest.approx(87.5, abs=0.1)
    gains = found.gains()[:, 0]
    report("gains [J]", np.round(gains, 3))
    assert gains.max() < 0
    assert not np.asarray(found.fault).any()


def check_gains(name: str, kind: str, worlds: int, steps: int) -> None:
    """No substep gains more than 2 J, or 1 % of the world's kinetic energy."""
    found = judge(driven(subject(name), kind, worlds, steps))
    report("gains", found)
    assert found.faults == 0
    assert found.substeps == 0


@pytest.mark.parametrize("kind", ACTIONS)
def test_no_substep_gains_energy(kind: str) -> None:
    check_gains("halfcheetah", kind, 32, 50)


@pytest.mark.parametrize("name", ["halfcheetah", *WALKING])
def test_drops_stay_below_their_first_energy(name: str) -> None:
    """Within 0.1 % of what they can spend."""
    found = dropped(subject(name), 8, 4.0)
    report("largest rise, as a share", excess(found).max())
    assert not np.asarray(found.fault).any()
    assert excess(found).max() < 1e-3


@pytest.mark.parametrize("speed", [5.0, 10.0, 15.0])
def test_acrobot_with_a_contact_keeps_its_energy(speed: float) -> None:
    """While the contact does not touch, as without it."""
    found, faulty = drift(touching_acrobot(), speed, 8, 30.0)
    report("largest change, of the kinetic energy at the start", np.abs(found).max())
    assert not faulty.any()
    assert np.abs(found).max() < 0.05


# Faults


def test_undamped_hexapod_has_no_fault_in_a_short_time() -> None:
    assert not faults(subject("hexapod-undamped"), 64, 500).any()


# Convergence


@pytest.mark.parametrize("busy", [False, True])
def test_error_is_of_first_order(busy: bool) -> None:
    """From h over h/2 to h/4, of the median world."""
    one = subject("halfcheetah")
    states = busy_states(one, 64) if busy else one.reset(64)
    medians = np.median(errors(one, *states), axis=1)
    slope = np.log2(medians[0] / medians[-1]) / 2
    report("median errors, order", (medians, slope))
    assert slope >= 0.8
    assert medians[0] < 0.1


# Friction


@pytest.mark.parametrize("name", WALKING)
def test_friction_stays_near_its_cone(name: str) -> None:
    ratios = friction_ratios(subject(name), 128, 60)
    shares = [50, 99, 99.9, 99.99, 100]
    report(f"percentiles {shares}", np.percentile(ratios, shares))
    assert len(ratios) > 10_000
    assert np.quantile(ratios, 0.9999) < 1.5
    assert ratios.max() < 2.0


# Gradients


def test_gradients_of_halfcheetah_over_32_steps() -> None:
    norms = gradient_norms("halfcheetah", 32, 32)
    report("norms: quartiles", np.quantile(norms, [0.25, 0.5, 0.75, 1.0]))
    assert np.median(norms) < 1e4


def test_horizon_of_halfcheetah() -> None:
    found = newton_qd.diagnose_gradients("halfcheetah", horizons=(1, 2, 4, 8, 16, 32))
    report("exact, useful", (found.exact_horizon, found.useful_horizon))
    assert min(found.exact_horizon, found.useful_horizon) >= 16
