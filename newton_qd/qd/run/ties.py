"""Equally fit individuals of one cell."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def without_ties(
    fitnesses: jax.Array, descriptors: jax.Array, centroids: jax.Array
) -> jax.Array:
    """Keeps the first of several equally fit individuals of one cell.

    QDax would write all of them to the same row of the archive. XLA does not define the
    order on a GPU.

    Args:
        fitnesses: (N,) returns.
        descriptors: (N, D) descriptors.
        centroids: (cells, D) centres of the cells.

    Returns:
        (N,) returns, ``-inf`` for the later ones.
    """
    from qdax.core.containers.mapelites_repertoire import get_cells_indices

    cells = get_cells_indices(descriptors, centroids)
    order = jnp.lexsort((fitnesses, cells))
    same = (cells[order][1:] == cells[order][:-1]) & (
        fitnesses[order][1:] == fitnesses[order][:-1]
    )
    later = jnp.concatenate([jnp.zeros((1,), bool), same])
    return jnp.where(jnp.zeros_like(later).at[order].set(later), -jnp.inf, fitnesses)
