"""Scores of elites that are replaced during a search, so that luck does not stay."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd.qd.run.ties import without_ties
from newton_qd.types import Repertoire


def renewed(
    repertoire: Repertoire,
    fitnesses: jax.Array,
    descriptors: jax.Array,
    weight: float,
) -> Repertoire:
    """Rebuilds an archive after its elites were evaluated again.

    An elite that was lucky loses fitness, or moves to the cell where it belongs. Fitness
    and descriptor become

    .. math:: (1 - w) \\cdot \\text{old} + w \\cdot \\text{new},

    so with a weight w below 1, they are averages over all evaluations of the elite.
    Without it, this is the archive sampling of Flageat et al. 2023 ("Uncertain
    Quality-Diversity: evaluation methodology and new methods for Quality-Diversity in
    uncertain domains").

    Args:
        repertoire: The archive.
        fitnesses: (cells,) new fitness of the elite of each cell; what stands in empty
            cells is ignored.
        descriptors: (cells, D) new descriptors.
        weight: Weight w of the new scores [-].

    Returns:
        The archive with all elites whose new scores are finite and that are the fittest
        of their cell.
    """
    filled = jnp.isfinite(repertoire.fitnesses[:, 0])
    sound = filled & jnp.isfinite(fitnesses) & jnp.isfinite(descriptors).all(axis=1)
    old = jnp.where(sound, repertoire.fitnesses[:, 0], 0)
    fresh = jnp.where(sound, fitnesses, 0)
    fitness = jnp.where(sound, (1 - weight) * old + weight * fresh, -jnp.inf)
    fresh = jnp.where(sound[:, None], descriptors, 0)
    descriptor = (1 - weight) * repertoire.descriptors + weight * fresh
    empty = repertoire.replace(
        genotypes=jnp.zeros_like(repertoire.genotypes),
        fitnesses=jnp.full_like(repertoire.fitnesses, -jnp.inf),
        descriptors=jnp.zeros_like(repertoire.descriptors),
    )
    kept = without_ties(fitness, descriptor, repertoire.centroids)
    return empty.add(repertoire.genotypes, descriptor, kept, {})


def entrants(repertoire, fitnesses, descriptors, most):
    """Returns the individuals (most,) that gain most, and whether they enter."""
    from qdax.core.containers.mapelites_repertoire import get_cells_indices

    most = min(most, len(fitnesses))
    kept = without_ties(fitnesses, descriptors, repertoire.centroids)
    cells = get_cells_indices(descriptors, repertoire.centroids)
    number = len(repertoire.centroids)
    kept = jnp.where(jnp.isfinite(descriptors).all(axis=1), kept, -jnp.inf)
    best = jax.ops.segment_max(kept, cells, num_segments=number)
    now = repertoire.fitnesses[cells, 0]
    enters = jnp.isfinite(kept) & (kept == best[cells]) & (kept > now)
    gain = jnp.where(enters, jnp.where(jnp.isfinite(now), kept - now, 1e9), -1.0)
    _, chosen = jax.lax.top_k(gain, most)
    return chosen, enters[chosen]


def merged(scores, chosen, ok, again):
    fitnesses = jnp.full_like(scores[0], -jnp.inf)
    fitnesses = fitnesses.at[chosen].set(jnp.where(ok, again[0], -jnp.inf))
    descriptors = scores[1].at[chosen].set(again[1])
    return fitnesses, descriptors, scores[2]
