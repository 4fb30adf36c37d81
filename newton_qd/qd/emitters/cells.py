"""Choice of cells of a repertoire: parents and targets of an emitter."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd.types import Repertoire

_ROUNDINGS = 16


def draw_cells(key: jax.Array, wanted: jax.Array, count: int) -> jax.Array:
    """Draws cells uniformly, with replacement.

    Args:
        key: Random key.
        wanted: (cells,) whether a cell can be drawn. If none can, all can.
        count: Number of cells.

    Returns:
        (count,) cells.
    """
    wanted = wanted | ~jnp.any(wanted)
    # whole numbers: sums of probabilities are rounded, and would let other cells in
    number = jnp.cumsum(wanted.astype(jnp.int32))
    drawn = jax.random.randint(key, (count,), 0, number[-1])
    return jnp.searchsorted(number, drawn, side="right").astype(jnp.int32)


def draw_elites(repertoire: Repertoire, key: jax.Array, count: int) -> jax.Array:
    """Draws cells (count,) with an individual, or any cells if none has one."""
    return draw_cells(key, repertoire.fitnesses[:, 0] > -jnp.inf, count)


def accepted_cells(
    repertoire: Repertoire, genotypes: jax.Array, descriptors: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Finds the individuals that a repertoire has accepted.

    An individual was accepted if its cell contains it now. This is correct for every
    rule of addition.

    Args:
        repertoire: Repertoire after the addition.
        genotypes: (N, size) the individuals.
        descriptors: (N, D) their descriptors.

    Returns:
        (N,) the cell of each individual, and (N,) whether the cell contains it.
    """
    from qdax.core.containers.mapelites_repertoire import get_cells_indices

    cells = get_cells_indices(descriptors, repertoire.centroids)
    elites = repertoire.genotypes[cells]
    # XLA may compute a genotype twice, for the repertoire and for the emitter, with
    # different rounding errors.
    allowed = _ROUNDINGS * jnp.finfo(elites.dtype).eps
    distance = jnp.max(jnp.abs(elites - genotypes), axis=-1)
    return cells, distance <= allowed * jnp.max(jnp.abs(elites), axis=-1)


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


def break_ties(
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
