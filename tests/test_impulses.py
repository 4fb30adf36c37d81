"""Impulses of single contacts: their sums are what a step reports for bodies."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics_helpers import random_states, variant

from newton_qd import physics
from newton_qd.robots import HALFCHEETAH, REACHER


@pytest.mark.slow
def test_impulses_add_up_to_those_of_bodies(x64: None) -> None:
    """Of halfcheetah: bodies with two contacts, and a pair that is pressed together."""
    system = variant(HALFCHEETAH, "float64", substeps=3)
    q, v, control = (
        jnp.asarray(x) for x in random_states(system, np.random.default_rng(0), 64)
    )
    names = list(system.joint_names)
    for thigh in ("bthigh", "fthigh"):
        inwards = -0.9 if thigh == "bthigh" else 0.9
        q = q.at[:, system.q_start[names.index(thigh)]].set(inwards)
    state = jax.vmap(functools.partial(physics.initial_state, system))(q, v)
    after, _ = jax.vmap(functools.partial(physics.step, system))(state, control)
    impulse, normal = (
        np.asarray(x)
        for x in jax.vmap(functools.partial(physics.contact_impulses, system))(
            state, control
        )
    )
    assert (normal >= 0).all() and (normal.max(axis=(0, 1)) > 0).any()
    of_body = np.eye(system.nb)[system.contact_body]
    np.testing.assert_allclose(
        np.einsum("wscj,cb->wbj", impulse, of_body), after.impulse[..., :3], atol=1e-12
    )
    np.testing.assert_allclose(
        np.einsum("wsc,cb->wb", normal, of_body), after.normal_impulse, atol=1e-12
    )
    ground = system.ground_contacts
    np.testing.assert_array_equal(impulse[..., ground, 2], normal[..., ground])
    for one, other in system.contact_pairs:
        assert (normal[..., one] > 0).any()
        np.testing.assert_array_equal(impulse[..., one, :], -impulse[..., other, :])


def test_what_touches_nothing_has_no_impulses() -> None:
    system = physics.load_system(REACHER)
    state = physics.initial_state(system, jnp.zeros(system.nq), jnp.zeros(system.nv))
    impulse, normal = physics.contact_impulses(system, state, jnp.zeros(system.nu))
    assert impulse.shape == (system.substeps, 0, 3)
    assert normal.shape == (system.substeps, 0)


def test_wrong_shape() -> None:
    system = physics.load_system(REACHER)
    state = physics.initial_state(system, jnp.zeros(system.nq), jnp.zeros(system.nv))
    with pytest.raises(ValueError, match=r"control: got .*shape \(1,\)"):
        physics.contact_impulses(system, state, jnp.zeros(1))
