"""Which cells of a repertoire an emitter starts from and aims at."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd.types import Repertoire


def draw_cells(key: jax.Array, wanted: jax.Array, count: int) -> jax.Array:
    """Draws cells uniformly, with replacement.

    Args:
        key: Random key.
        wanted: (cells,) which ones; all of them if none is.
        count: Number of cells.

    Returns:
        (count,) cells.
    """
    weights = (wanted | ~jnp.any(wanted)).astype(jnp.float32)
    probabilities = weights / jnp.sum(weights)
    return jax.random.choice(key, wanted.shape[0], (count,), p=probabilities)


def empty_targets(repertoire: Repertoire, key: jax.Array, count: int) -> jax.Array:
    """(count, D) centres of empty cells; of any cells once none is empty."""
    cells = draw_cells(key, repertoire.fitnesses[:, 0] == -jnp.inf, count)
    return repertoire.centroids[cells]


def nearest_cells(
    descriptors: jax.Array, wanted: jax.Array, targets: jax.Array
) -> jax.Array:
    """Finds the individuals whose descriptors are nearest to targets.

    Args:
        descriptors: (cells, D) descriptors of the individuals.
        wanted: (cells,) which cells hold one that counts.
        targets: (N, D) targets.

    Returns:
        (N,) cells.
    """

    def nearest(target: jax.Array) -> jax.Array:
        distances = jnp.sum((descriptors - target) ** 2, axis=-1)
        return jnp.argmin(jnp.where(wanted, distances, jnp.inf))

    return jax.vmap(nearest)(targets)
