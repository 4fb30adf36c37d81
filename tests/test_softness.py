"""The softness of contacts as a knob."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import pytest

import newton_qd
from newton_qd.gradients import soft_to_stiff, softened
from newton_qd.robots import ANT, HOPPER, Material


def test_create_takes_a_material() -> None:
    soft = softened(HOPPER.material, 4.0)
    env: Any = newton_qd.create("hopper_uni", material=soft)
    assert env.unwrapped.robot.material == soft
    plain: Any = newton_qd.create("hopper_uni")
    assert plain.unwrapped.robot is HOPPER
    ratio = plain.system.contact_stiffness / env.system.contact_stiffness
    np.testing.assert_allclose(ratio, 4.0, 1e-12)
    state = jax.jit(env.step)(env.reset(jax.random.key(0)), np.zeros(3, np.float32))
    newton_qd.check(state)
    trap: Any = newton_qd.create("anttrap", material=softened(ANT.material, 2.0))
    assert trap.system.scene is not None
    assert trap.unwrapped.robot.material.smoothing == 2 * ANT.material.smoothing


def test_soft_to_stiff() -> None:
    env: Any = newton_qd.create("hopper_uni", fixed_init_state=True)
    soft: Any
    stiff: Any
    soft, stiff = soft_to_stiff(env, (3.0, 1.0))
    assert stiff.unwrapped.robot.material == env.unwrapped.robot.material
    material, reference = soft.unwrapped.robot.material, HOPPER.material
    assert material.static_penetration == 3 * reference.static_penetration
    assert material.limit_overshoot == 3 * reference.limit_overshoot
    assert material.friction == reference.friction
    assert env.unwrapped.robot is HOPPER


def test_every_scale_of_softness_changes() -> None:
    scales = {"static_penetration", "smoothing", "slip_velocity"}
    scales |= {"limit_overshoot", "limit_smoothing"}
    soft = softened(HOPPER.material, 3.0)
    for name, value in vars(HOPPER.material).items():
        assert getattr(soft, name) == (3 * value if name in scales else value), name


def test_bad_softness() -> None:
    for factor in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=f"factor: got {factor}"):
            softened(Material(), factor)
    maze = newton_qd.create("pointmaze")
    with pytest.raises(
        NotImplementedError, match="env: got pointmaze, which is not a simulated robot"
    ):
        soft_to_stiff(maze)
    with pytest.raises(NotImplementedError, match="pointmaze is not a simulated robot"):
        newton_qd.create("pointmaze", material=Material())
