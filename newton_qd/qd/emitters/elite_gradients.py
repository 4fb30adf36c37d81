"""The gradients of the elites, kept beside the repertoire, and emitters that use them.

The loop evaluates every individual once and gets its gradients with its scores.
Keeping those of the elites saves evaluating a parent again when it is chosen.
"""

from __future__ import annotations

import abc
from typing import Any

import jax
import jax.numpy as jnp
from qdax.core.containers.mapelites_repertoire import get_cells_indices
from qdax.core.emitters.emitter import Emitter, EmitterState
from qdax.core.emitters.repertoire_selectors.selector import Selector

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.qd.scoring.gradient_scores import Scores, read_scores
from newton_qd.types import (
    ExtraScores,
    Genotype,
    PyTree,
    Repertoire,
    ScoringFunction,
)

_ROUNDINGS = 16


class EliteGradients(EmitterState):
    """Gradients of the individuals that a repertoire holds.

    Attributes:
        gradients: (cells, 1 + D, size) gradients of the elite of each cell.
        fitnesses: (cells,) fitness of the individual that the gradients belong to,
            ``-inf`` where there is none. Gradients count only while the cell holds
            an individual of this fitness.
        rejected: () individuals so far with a score or gradient that is not finite.
    """

    gradients: jax.Array
    fitnesses: jax.Array
    rejected: jax.Array

    def add(self, repertoire: Repertoire, scores: Scores) -> EliteGradients:
        """Keeps the gradients of those individuals that the repertoire took.

        The repertoire decides: an individual counts as taken if its cell holds it.
        That is right for every rule of addition.

        Args:
            repertoire: Repertoire after the addition.
            scores: The individuals that were added.
        """
        cells = get_cells_indices(scores.descriptors, repertoire.centroids)
        elites, fitnesses = repertoire.genotypes[cells], repertoire.fitnesses[cells, 0]
        # XLA may compute a genotype once for the repertoire and once for this, with
        # other roundings.
        allowed = _ROUNDINGS * jnp.finfo(elites.dtype).eps
        distance = jnp.max(jnp.abs(elites - scores.genotypes), axis=-1)
        held = distance <= allowed * jnp.max(jnp.abs(elites), axis=-1)
        target = jnp.where(held & scores.finite, cells, self.fitnesses.shape[0])
        return EliteGradients(
            gradients=self.gradients.at[target].set(scores.gradients, mode="drop"),
            fitnesses=self.fitnesses.at[target].set(fitnesses, mode="drop"),
            rejected=self.rejected + jnp.sum(~scores.finite, dtype=jnp.int32),
        )

    def known(self, repertoire: Repertoire) -> jax.Array:
        """(cells,) whether a cell holds an elite whose gradients are known."""
        filled = repertoire.fitnesses[:, 0] > -jnp.inf
        return filled & (repertoire.fitnesses[:, 0] == self.fitnesses)

    def at(self, repertoire: Repertoire, cells: jax.Array) -> jax.Array:
        """(N, 1 + D, size) gradients of the elites of some cells, zero if unknown."""
        known = self.known(repertoire)[cells]
        return jnp.where(known[:, None, None], self.gradients[cells], 0)

    def select(
        self,
        repertoire: Repertoire,
        key: jax.Array,
        count: int,
        selector: Selector | None = None,
    ) -> jax.Array:
        """Draws cells whose elites have gradients; any filled ones if none has.

        Args:
            repertoire: Repertoire of the elites.
            key: Random key.
            count: Number of parents.
            selector: Selector of QDax; None draws uniformly with replacement.

        Returns:
            (count,) cells.
        """
        known = self.known(repertoire)
        usable = (known | ~jnp.any(known))[:, None]
        numbered = repertoire.replace(
            genotypes=jnp.arange(known.shape[0]),
            fitnesses=jnp.where(usable, repertoire.fitnesses, -jnp.inf),
        )
        return numbered.select(key, count, selector).genotypes


class EliteGradientEmitter(Emitter, abc.ABC):
    """An emitter whose parents are elites with known gradients."""

    def __init__(self, batch_size: int, selector: Selector | None = None) -> None:
        """Sets how parents are drawn.

        Args:
            batch_size: Individuals emitted in one iteration.
            selector: Selector of QDax; None draws uniformly with replacement.

        Raises:
            ValueError: The batch is empty.
        """
        checks.integer("batch_size", batch_size, most=None)
        self._batch_size = batch_size
        self._selector = selector

    @property
    def batch_size(self) -> int:
        """Individuals emitted in one iteration."""
        return self._batch_size

    @property
    def use_all_data(self) -> bool:
        """Elites that other emitters found are parents too."""
        return True

    def init(
        self,
        key: jax.Array,
        repertoire: Repertoire,
        genotypes: Genotype,
        fitnesses: jax.Array,
        descriptors: jax.Array,
        extra_scores: ExtraScores,
    ) -> EliteGradients:
        """Keeps the gradients of the initial elites.

        Raises:
            GradientsError: ``extra_scores`` holds no gradients of the right shape.
        """
        del key
        scores = read_scores(genotypes, fitnesses, descriptors, extra_scores)
        cells = repertoire.centroids.shape[0]
        empty = EliteGradients(
            gradients=jnp.zeros((cells, *scores.gradients.shape[1:]), genotypes.dtype),
            fitnesses=jnp.full((cells,), -jnp.inf, repertoire.fitnesses.dtype),
            rejected=jnp.zeros((), jnp.int32),
        )
        return empty.add(repertoire, scores)

    def state_update(
        self,
        emitter_state: PyTree,
        repertoire: Repertoire = None,
        genotypes: Genotype | None = None,
        fitnesses: Any = None,
        descriptors: Any = None,
        extra_scores: ExtraScores | None = None,
    ) -> EliteGradients:
        """Keeps the gradients of the new elites.

        Raises:
            GradientsError: ``extra_scores`` holds no gradients of the right shape.
        """
        scores = read_scores(genotypes, fitnesses, descriptors, extra_scores)
        return emitter_state.add(repertoire, scores)


def check_steps(steps: int, scoring_function: ScoringFunction | None) -> None:
    """Checks the number of gradient steps of an offspring.

    Raises:
        ValueError: It is below 1, or needs a scoring function that is not given.
    """
    checks.integer("steps", steps, most=None)
    if steps > 1 and scoring_function is None:
        raise ValueError(message("steps", steps, "1 without a scoring_function"))
