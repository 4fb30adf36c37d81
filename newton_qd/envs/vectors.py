"""Arithmetic with finite gradients that is bitwise equal in every batch size."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np


def rounded(product: jax.Array) -> jax.Array:
    """Returns products (...) as they are, rounded before they are added to anything.

    A compiler may fuse a product with the sum that it goes into, which rounds once
    instead of twice. Whether it does, and with which of two products, depends on the
    batch. A selection between the two, here of every number that is not nan, is
    what compilers cannot see through; a barrier is removed before they fuse.
    """
    return jnp.where(product == product, product, jnp.full_like(product, jnp.nan))


def ordered_sum(terms: jax.Array) -> jax.Array:
    """Sums (n, ...) terms from the first to the last.

    The order of ``jnp.sum`` depends on the batch; this one does not, so that one
    world gives bitwise the same in any batch. For a few dozen terms.
    """
    terms = rounded(terms)
    total = terms[0]
    for index in range(1, terms.shape[0]):
        total = total + terms[index]
    return total


def length(vector: jax.Array) -> jax.Array:
    """Returns the norm of (n,), with gradient 0 instead of nan at 0."""
    square = ordered_sum(jnp.square(vector))
    zero = square == 0  # not "is not above": a nan stays one
    root = jnp.sqrt(jnp.where(zero, jnp.ones_like(square), square))
    return jnp.where(zero, jnp.zeros_like(root), root)


def wrapped(angle: jax.Array) -> jax.Array:
    """Returns angles (...) plus whole turns, between -pi and pi [rad]."""
    turn = np.asarray(2 * np.pi, angle.dtype)
    return angle - turn * jnp.round(angle / turn)


def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Returns the cross products (n, 3) of the rows of two arrays (n, 3)."""
    ahead, behind = np.array([1, 2, 0]), np.array([2, 0, 1])
    left, right = a[:, ahead] * b[:, behind], a[:, behind] * b[:, ahead]
    return rounded(left) - rounded(right)


def rotated(quaternion: jax.Array, vector: jax.Array) -> jax.Array:
    """Returns the rows of vectors (n, 3) turned by quaternions xyzw (n, 4)."""
    axis, w = quaternion[:, :3], quaternion[:, 3:]
    turned = 2 * cross(axis, vector)
    return vector + rounded(w * turned) + cross(axis, turned)
