"""Ranks of offspring by their effect on an archive."""

from __future__ import annotations

import jax
import jax.numpy as jnp

# Classes of offspring (pyribs' status); failed offspring are last.
NEW, IMPROVED, WORSE, FAILED = 2, 1, 0, -1
# pyribs' limit for the spread of values in a batch.
_FLAT = 1e-12


def best_of(
    classes: jax.Array, values: jax.Array, finite: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Sorts the offspring of one point, best first.

    Args:
        classes: (B,) class of each offspring; higher is better.
        values: (B,) value within a class; higher is better.
        finite: (B,) whether fitness and descriptor are finite. If not, the offspring
            has failed.

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
