"""The gradient to the stiffness of contacts, where the stiffness is 0."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from urdf_text import joint, link, robot_text, row, sphere, write

from newton_qd import physics
from newton_qd.physics.model import build_system
from newton_qd.robots import Contact


@pytest.mark.slow
def test_gradient_without_stiffness(x64: None, tmp_path: Path) -> None:
    """It is one-sided, also where a motor lifts a foot off within the substep."""
    foot = link("foot", sphere(0.1))
    slide = joint("slide", "prismatic", "world", "foot", '<axis xyz="0 0 1"/>')
    urdf = write(tmp_path, robot_text('<link name="world"/>', foot, slide))
    robot = row(
        urdf,
        "foot",
        actuators=(("slide", 1000.0),),
        contacts=(Contact("foot"),),
        substeps=1,
    )
    system = build_system(robot, "float64")
    default = physics.default_params(system)
    state = physics.initial_state(system, jnp.array([0.095]), jnp.zeros(1))

    def velocity(scale: jax.Array, action: jax.Array) -> jax.Array:
        params = default.replace(contact_stiffness_scale=scale)
        return physics.step(system, state, action[None], params)[0].v[0]

    value, slope = jax.jit(velocity), jax.jit(jax.grad(velocity))
    for action in jnp.array([0.0, 0.02, 0.05, 0.1, 0.3]):
        first, second, third = (value(x, action) for x in (0.0, 1e-6, 2e-6))
        difference = float(4 * second - 3 * first - third) / 2e-6
        exact = float(slope(0.0, action))
        assert exact == pytest.approx(difference, rel=1e-6, abs=1e-8)
