"""Wrong arguments of the functions of ``newton_qd.physics`` are named."""

from __future__ import annotations

import inspect
from typing import Any

import jax
import jax.numpy as jnp
import pytest

import newton_qd
from newton_qd import physics
from newton_qd.robots import HOPPER

SYSTEM = physics.load_system(HOPPER)
Q, V = jnp.zeros(SYSTEM.nq), jnp.zeros(SYSTEM.nv)


def takers() -> dict[str, int]:
    """Names of the functions of a system, and the number of their other arguments."""
    found = {}
    for name in physics.__all__:
        value: Any = getattr(physics, name)
        if inspect.isfunction(value):
            parameters = inspect.signature(value).parameters.values()
            needed = [each.name for each in parameters if each.default is each.empty]
            if needed[0] == "system":
                found[name] = len(needed) - 1
    return found


def test_functions_of_a_system_are_found() -> None:
    assert {"step", "wall_speeds", "grounding_coordinate"} < takers().keys()


@pytest.mark.parametrize("name", takers())
def test_an_environment_is_no_system(name: str) -> None:
    function: Any = getattr(physics, name)
    for wrong in (newton_qd.create("pointmaze"), None):
        with pytest.raises(
            TypeError, match=r"^system: got .*; allowed: a System, such"
        ):
            function(wrong, *[None] * takers()[name])


@pytest.mark.parametrize("name", ["step", "rollout", "contact_impulses", "seen_bodies"])
def test_a_state_of_an_environment_is_no_state_of_the_physics(name: str) -> None:
    function: Any = getattr(physics, name)
    control = () if name == "seen_bodies" else (jnp.zeros(SYSTEM.nu),)
    with pytest.raises(TypeError, match=r"^state: got None; allowed: a PhysicsState"):
        function(SYSTEM, None, *control)


def test_functions_of_a_float64_system_need_x64(x64: None) -> None:
    """Otherwise JAX rounds the row, and the error names a dtype that nobody gave."""
    system = physics.load_system(HOPPER, "float64")
    q, v = jnp.zeros(system.nq), jnp.zeros(system.nv)
    state, control = physics.initial_state(system, q, v), jnp.zeros(system.nu)
    calls: dict[str, tuple[Any, ...]] = {
        "default_params": (),
        "step": (state, control),
        "rollout": (state, control[None]),
        "seen_bodies": (state,),
        "contact_impulses": (state, control),
        "initial_state": (q, v),
        "bias_forces": (q, v),
        "unit_quaternions": (q,),
    }
    words = r"^dtype: got 'float64' while JAX x64 is off; allowed: 'float32', or jax.co"
    for name, arguments in calls.items():
        with jax.enable_x64(False), pytest.raises(ValueError, match=words):
            getattr(physics, name)(system, *arguments)


def test_coordinates_are_real_numbers() -> None:
    wrong: Any = "abc"
    for function in (physics.forward_kinematics, physics.initial_state):
        with pytest.raises(TypeError, match=r"^q: got complex numbers; allowed: real"):
            function(SYSTEM, Q + 1j, V)
        with pytest.raises(
            TypeError, match=r"^q: got 'abc'; allowed: an array of shap"
        ):
            function(SYSTEM, wrong, V)


def test_the_result_of_a_rollout_is_no_parameters() -> None:
    state = physics.initial_state(SYSTEM, Q, V)
    controls = jnp.zeros((3, SYSTEM.nu))
    found: Any = physics.rollout(SYSTEM, state, controls)
    with pytest.raises(TypeError, match=r"^params: got Foreseen.*; allowed: None, or"):
        physics.step(SYSTEM, state, controls[0], found)
    env = newton_qd.create("hopper", auto_reset=False)
    words = r"^params: got the result of a rollout of 3 steps; allowed: None, or"
    with pytest.raises(ValueError, match=words):
        env.step(env.reset(jax.random.key(0)), controls[0], found)
