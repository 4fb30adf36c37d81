"""Arithmetic with finite gradients that is bitwise equal in every batch size."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np


def rounded(product: jax.Array) -> jax.Array:
    """Returns products (...) unchanged, but rounded before they are added.

    A compiler may fuse a product and a sum into one operation that rounds once instead
    of twice. Whether it does this, and with which of two products, depends on the
    batch. It cannot fuse through the selection used here. An optimization barrier does
    not help, because XLA removes barriers before it fuses.
    """
    if not jnp.issubdtype(jnp.result_type(product), jnp.inexact):
        return product
    # a constant, because jax.debug_nans finds an array of NaN that is computed
    return jnp.where(product == product, product, jnp.nan)


def ordered_sum(terms: jax.Array) -> jax.Array:
    """Sums (n, ...) terms from the first to the last.

    The order of ``jnp.sum`` depends on the batch size. This order does not, so a world
    gives bitwise the same result in any batch. Use it for at most a few dozen terms.
    """
    # one split, because a slice and a squeeze of each term take long to trace
    first, *others = jax.lax.split(rounded(terms), [1] * terms.shape[0])
    total = first
    for term in others:
        total = total + term
    return total[0]


def length(vector: jax.Array) -> jax.Array:
    """Returns the norm of (n,), with gradient 0 instead of nan at 0."""
    square = ordered_sum(jnp.square(vector))
    zero = square == 0  # not "~(square > 0)", so that nan stays nan
    root = jnp.sqrt(jnp.where(zero, jnp.ones_like(square), square))
    return jnp.where(zero, jnp.zeros_like(root), root)


def wrapped(angle: jax.Array) -> jax.Array:
    """Returns angles (...) shifted by multiples of 2 pi to between -pi and pi [rad]."""
    angle = jnp.asarray(angle)
    if not jnp.issubdtype(angle.dtype, jnp.floating):
        angle = angle.astype(jnp.result_type(float))
    turn = np.asarray(2 * np.pi, angle.dtype)
    return angle - turn * jnp.round(angle / turn)


def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Returns the cross products (n, 3) of the rows of two arrays (n, 3)."""
    ahead, behind = np.array([1, 2, 0]), np.array([2, 0, 1])
    left, right = a[:, ahead] * b[:, behind], a[:, behind] * b[:, ahead]
    return rounded(left) - rounded(right)


def rotated(quaternion: jax.Array, vector: jax.Array) -> jax.Array:
    """Returns vectors (n, 3) rotated by quaternions xyzw (n, 4)."""
    axis, w = quaternion[:, :3], quaternion[:, 3:]
    turned = 2 * cross(axis, vector)
    return vector + rounded(w * turned) + cross(axis, turned)
