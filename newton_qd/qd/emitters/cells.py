"""Choice of cells of a repertoire: parents and targets of an emitter."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd.types import Repertoire


def draw_cells(key: jax.Array, wanted: jax.Array, count: int) -> jax.Array:
    """Draws cells uniformly, with replacement.

    Args:
        key: Random key.
        wanted: (cells,) whether a cell can be drawn. If none can, all can.
        count: Number of cells.

    Returns:
        (count,) cells.
    """
    weights = (wanted | ~jnp.any(wanted)).astype(jnp.float32)
    probabilities = weights / jnp.sum(weights)
    return jax.random.choice(key, wanted.shape[0], (count,), p=probabilities)


def empty_targets(repertoire: Repertoire, key: jax.Array, count: int) -> jax.Array:
    """Draws centres (count, D) of empty cells, or of any cells if none is empty."""
    cells = draw_cells(key, repertoire.fitnesses[:, 0] == -jnp.inf, count)
    return repertoire.centroids[cells]


def nearest_cells(
    descriptors: jax.Array, wanted: jax.Array, targets: jax.Array
) -> jax.Array:
    """Finds the individuals whose descriptors are nearest to targets.

    Args:
        descriptors: (cells, D) descriptors of the individuals.
        wanted: (cells,) whether the individual of a cell counts.
        targets: (N, D) targets.

    Returns:
        (N,) cells.
    """

    def nearest(target: jax.Array) -> jax.Array:
        distances = jnp.sum((descriptors - target) ** 2, axis=-1)
        return jnp.argmin(jnp.where(wanted, distances, jnp.inf))

    return jax.vmap(nearest)(targets)
