"""Ranks of offspring by what they would do to an archive."""

from __future__ import annotations

import jax
import jax.numpy as jnp

# Classes of offspring (pyribs' status); what failed comes last.
NEW, IMPROVED, WORSE, FAILED = 2, 1, 0, -1
# pyribs' limit for the spread of values in a batch.
_FLAT = 1e-12


def best_of(
    classes: jax.Array, values: jax.Array, finite: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Orders the offspring of one point, the best first.

    Args:
        classes: (B,) class of each, the higher the better.
        values: (B,) value within a class, the higher the better.
        finite: (B,) whether fitness and descriptor are finite; others have failed.

    Returns:
        (B,) indices, and whether all offspring are equally good ().
    """
    classes = jnp.where(finite, classes, FAILED)
    values = jnp.where(finite, values, 0)
    best_first = jnp.lexsort((-values, -classes))
    flat = (jnp.max(classes) == jnp.min(classes)) & (
        jnp.max(values) - jnp.min(values) < _FLAT
    )
    return best_first, flat
