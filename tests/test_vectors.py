"""Arithmetic of the environments: one rounding in every batch, finite gradients."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from newton_qd.envs.points import point
from newton_qd.envs.vectors import cross, length, ordered_sum, wrapped
from newton_qd.physics.inspection import Kinematics

pytestmark = pytest.mark.optimized
ROWS = np.random.default_rng(0).normal(size=(2, 64, 3)).astype(np.float32)


def test_products_are_rounded_before_they_are_subtracted() -> None:
    a, b = ROWS
    found = jax.jit(cross)(a, b)
    np.testing.assert_allclose(found, np.cross(a, b), rtol=1e-5, atol=1e-6)
    exact = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]  # NumPy rounds every product
    np.testing.assert_array_equal(found[:, 0], exact)


def test_products_are_rounded_before_they_are_summed() -> None:
    found = jax.jit(jax.vmap(lambda row: ordered_sum(jnp.square(row))))(ROWS[0])
    square = ROWS[0] ** 2
    exact = square[:, 0] + square[:, 1] + square[:, 2]
    np.testing.assert_array_equal(found, exact)


def test_rounding_passes_the_gradient() -> None:
    gradient = jax.grad(lambda row: ordered_sum(jnp.square(row)))(ROWS[0, 0])
    np.testing.assert_array_equal(gradient, 2 * ROWS[0, 0])


@pytest.mark.parametrize("function", [length, ordered_sum])
@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_values_that_are_not_finite_stay(
    function: Callable[[jax.Array], jax.Array], number: float
) -> None:
    vector = jnp.array([1.0, number, 0.0], np.float32)
    np.testing.assert_array_equal(function(vector), np.float32(number))


def test_a_vector_of_zeros_has_no_length_and_no_slope() -> None:
    value, slope = jax.value_and_grad(length)(jnp.zeros(3, np.float32))
    assert value == 0 and not slope.any()


def test_whole_angles_are_wrapped_too() -> None:
    found = wrapped(jnp.array([4, -7, 3], np.int32))
    np.testing.assert_allclose(found, [4 - 2 * np.pi, 2 * np.pi - 7, 3], rtol=1e-6)


def test_a_point_moves_with_its_body() -> None:
    """A body that rises, turned by a quarter about z and turning on by 2 rad/s."""
    half = math.sqrt(0.5)
    rows = [
        [1.0, 2.0, 3.0],
        [0, 0, half, half],
        [1.0, 4.0, 3.0],
        [0, 0, 5.0],
        [0, 0, 2.0],
    ]
    seen = Kinematics(*(jnp.array([np.zeros(len(x)), x], np.float32) for x in rows))
    place, velocity = point(seen, 1, (1.0, 0.0, 0.0))
    # one metre along y from the origin of the link, one behind the centre of mass
    np.testing.assert_allclose(place, [1, 3, 3], rtol=1e-6)
    np.testing.assert_allclose(velocity, [2, 0, 5], rtol=1e-6, atol=1e-6)
