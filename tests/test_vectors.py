"""Arithmetic of the environments: one rounding in every batch, finite gradients."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from newton_qd.envs.vectors import cross, length, ordered_sum

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
