"""Vector algebra whose gradients are finite and whose sums have one order."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd.envs.base import ordered_sum


def length(vector: jax.Array) -> jax.Array:
    """Returns the norm of (n,), with gradient 0 instead of nan at 0."""
    square = ordered_sum(jnp.square(vector))
    positive = square > 0
    root = jnp.sqrt(jnp.where(positive, square, jnp.ones_like(square)))
    return jnp.where(positive, root, jnp.zeros_like(root))
