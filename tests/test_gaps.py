"""Gaps of contacts: to the ground, to walls, and of pairs."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics_helpers import beside_a_wall, nearest, random_states

from newton_qd import physics
from newton_qd.physics import reference
from newton_qd.physics.system import System
from newton_qd.robots import ANT, HALFCHEETAH, REACHER
from newton_qd.scenes import MAZE


def gaps(system: System, q: np.ndarray) -> np.ndarray:
    """Gaps (n, nc) in several worlds."""
    return np.asarray(
        jax.vmap(functools.partial(physics.contact_gaps, system))(jnp.asarray(q))
    )


def drawn(system: System) -> np.ndarray:
    """Coordinates (n, nq), half of them pressed into the ground."""
    return random_states(system, np.random.default_rng(0), 8)[0]


def test_gaps_to_the_ground(x64: None) -> None:
    system = physics.load_system(ANT, "float64")
    q = drawn(system)
    lowest = gaps(system, q)[:, system.ground_contacts].min(axis=1)
    expected = [reference.lowest_contact(system, world) for world in q]
    np.testing.assert_allclose(lowest, expected, atol=1e-12)
    assert (lowest[:4] < 0).all() and (lowest[4:] > 0).all()


def test_gaps_to_walls(x64: None) -> None:
    """Spheres and the capsules of the walls, to the smoothing of their ends (6 mm)."""
    system = physics.load_system(ANT, "float64", MAZE)
    q = beside_a_wall(system, drawn(system), np.random.default_rng(1))
    found = gaps(system, q)
    walls = np.flatnonzero(
        (system.contact_obstacle > 0) & ~system.contact_segment.any(axis=1)
    )
    assert len(walls)
    frames = np.array([reference.body_frames(system, world) for world in q])
    for row in walls:
        obstacle = system.contact_obstacle[row]
        frame, size = system.obstacle_frame[obstacle], system.obstacle_size[obstacle]
        local = np.append(system.contact_position[row], [0.0, 0.0, 0.0, 1.0])
        back = reference.inverse(frame)
        at = np.array(
            [
                reference.compose(back, reference.compose(body, local))[:3]
                for body in frames[:, system.contact_body[row]]
            ]
        )
        distance = nearest(at, np.zeros_like(at), size[1])
        expected = distance - size[0] - system.contact_radius[row]
        np.testing.assert_allclose(found[:, row], expected, atol=6e-3)


def test_both_rows_of_a_pair_have_its_gap(x64: None) -> None:
    system = physics.load_system(HALFCHEETAH, "float64")
    found = gaps(system, drawn(system))
    for one, other in system.contact_pairs:
        np.testing.assert_array_equal(found[:, one], found[:, other])
        assert (found[:, one] != found[:, 0]).all()


def test_what_touches_nothing_has_no_gaps() -> None:
    system = physics.load_system(REACHER)
    assert physics.contact_gaps(system, jnp.zeros(system.nq)).shape == (0,)


def test_wrong_shape() -> None:
    system = physics.load_system(REACHER)
    with pytest.raises(ValueError, match=r"q: got .*shape \(1,\)"):
        physics.contact_gaps(system, jnp.zeros(1))
