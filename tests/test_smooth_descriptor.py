"""The smooth descriptor: its limit, and what it leaves alone."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics_helpers import report

import newton_qd
from newton_qd.envs.state import State
from newton_qd.extractors import (
    Trajectories,
    get_feet_contact_proportion,
)
from newton_qd.gradients import (
    with_smooth_descriptor,
)
from newton_qd.wrappers import FeetContactWrapper

WIDTHS = (1.0, 0.1, 1e-2, 1e-3, 1e-4, 1e-5)


@functools.cache
def proportions(env: Any, steps: int = 40) -> Any:
    """Jitted feet-contact proportion (nf,) of an episode, and its loads (t, nf)."""

    def run(actions: jax.Array) -> tuple[jax.Array, jax.Array]:
        def advance(state: State, action: jax.Array) -> tuple[State, Any]:
            reading = state.info["state_descriptor"]
            load = state.pipeline_state.normal_impulse[env.system.feet]
            return env.step(state, action), (reading, load)

        start = env.reset(jax.random.key(0))
        _, (readings, loads) = jax.lax.scan(advance, start, actions)
        data, mask = Trajectories(readings[None]), jnp.zeros((1, steps), env.dtype)
        return get_feet_contact_proportion(data, mask)[0], loads

    return jax.jit(jax.value_and_grad(lambda a: run(a)[0].sum())), jax.jit(run)


@pytest.mark.slow
def test_smooth_proportion_goes_to_the_boolean_one() -> None:
    """As the width goes to 0, and a straight-through one is it at any width."""
    plain: Any = newton_qd.create("hopper_uni", auto_reset=False)
    actions = jax.random.uniform(jax.random.key(1), (40, 3), jnp.float32, -1.0, 1.0)
    expected, loads = proportions(plain)[1](actions)
    assert 0 < expected[0] < 1
    robot, mass = plain.unwrapped.robot, plain.system.total_mass
    shares = np.asarray(loads) / (mass * robot.gravity * robot.dt)
    assert np.abs(shares - 0.01).min() > 1e-3
    errors = []
    for width in WIDTHS:
        smooth = with_smooth_descriptor(plain, width)
        value, _ = proportions(smooth)[1](actions)
        errors.append(float(np.abs(value - expected).max()))
    report("distance from the boolean proportion by width", errors)
    assert (np.diff(errors) <= 0).all()
    assert errors[-1] < 1e-6
    through = with_smooth_descriptor(plain, 0.1, straight_through=True)
    value, gradient = proportions(through)[0](actions)
    assert value == expected.sum()
    smooth = with_smooth_descriptor(plain, 0.1)
    np.testing.assert_array_equal(gradient, proportions(smooth)[0](actions)[1])
    assert np.abs(gradient).max() > 0


def test_smooth_descriptor_leaves_the_environment_as_it_was() -> None:
    env: Any = newton_qd.create("ant_uni")
    smooth = with_smooth_descriptor(env, 0.05)
    asked = newton_qd.create("ant_uni", qdax_wrappers_kwargs=[{"smooth_width": 0.05}])
    key = jax.random.key(0)
    readings = [
        np.asarray(e.reset(key).info["state_descriptor"]) for e in (env, smooth, asked)
    ]
    assert not readings[0].any()
    np.testing.assert_array_equal(readings[1], readings[2])
    assert readings[1].all()
    stepped = with_smooth_descriptor(env, 0.05, straight_through=True)
    assert not np.asarray(stepped.reset(key).info["state_descriptor"]).any()
    tail: Any = with_smooth_descriptor(env, 0.05, tail="algebraic")
    assert (tail.system.feet_width, tail.system.feet_tail) == (0.05, "algebraic")
    for name in ("ant_omni", "pointmaze"):
        other = newton_qd.create(name)
        same: Any = with_smooth_descriptor(other)
        assert same.state_descriptor_name == "xy_position"
    with pytest.raises(ValueError, match=r"width: got 0.*above 0"):
        with_smooth_descriptor(env, 0.0)
    with pytest.raises(ValueError, match=r"tail: got 'none'; allowed: exponential, a"):
        with_smooth_descriptor(env, 0.1, tail="none")
    with pytest.raises(ValueError, match=r"smooth_width: got None.*width above 0"):
        newton_qd.create("ant_uni", qdax_wrappers_kwargs=[{"straight_through": True}])
    options = [{"smooth_width": 0.1, "straight_through": "no"}]
    with pytest.raises(TypeError, match="straight_through: got 'no'; allowed: True, F"):
        newton_qd.create("ant_uni", qdax_wrappers_kwargs=options)


class FeetInTheAir(FeetContactWrapper):
    """Another descriptor of the same contacts."""

    def describe(self, state: State) -> jax.Array:
        return 1 - super().describe(state)


def test_a_descriptor_of_your_own_stays_what_it_is() -> None:
    env = newton_qd.create("ant", episode_length=None, auto_reset=False)
    own = FeetInTheAir(env, "ant")
    smooth = with_smooth_descriptor(own, 0.1)
    assert isinstance(smooth, FeetInTheAir)
    readings = [
        e.reset(jax.random.key(0)).info["state_descriptor"] for e in (own, smooth)
    ]
    np.testing.assert_array_equal(readings[0], 1)
    assert np.all(readings[1] < 1)


def test_the_text_of_a_smooth_environment_has_its_name() -> None:
    env = newton_qd.create("ant_uni", episode_length=None, auto_reset=False)
    assert repr(with_smooth_descriptor(env, 0.1)).startswith("<ant_uni: ")
