"""The stored gradients of the elites, and emitters that use them.

The loop evaluates every individual once, with its gradients. The gradients of elites
are stored, so that parents do not need another evaluation.
"""

from __future__ import annotations

import abc
from typing import Any

import jax
import jax.numpy as jnp
from qdax.core.emitters.emitter import Emitter, EmitterState
from qdax.core.emitters.repertoire_selectors.selector import Selector

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.qd.emitters.cells import accepted_cells
from newton_qd.qd.scoring.gradient_scores import Scores, read_scores
from newton_qd.types import (
    ExtraScores,
    Genotype,
    PyTree,
    Repertoire,
    ScoringFunction,
)


class EliteGradients(EmitterState):
    """Gradients of the individuals in a repertoire.

    Attributes:
        gradients: (cells, 1 + D, size) gradients of the elite of each cell.
        fitnesses: (cells,) fitness of the individual with these gradients, ``-inf`` if
            there are no gradients. Gradients count only while the cell has an
            individual with this fitness.
        rejected: () number of individuals so far with a score or gradient that is not
            finite.
    """

    gradients: jax.Array
    fitnesses: jax.Array
    rejected: jax.Array

    def add(self, repertoire: Repertoire, scores: Scores) -> EliteGradients:
        """Stores the gradients of the individuals that the repertoire accepted.

        Args:
            repertoire: Repertoire after the addition.
            scores: The evaluated individuals.
        """
        cells, held = accepted_cells(repertoire, scores.genotypes, scores.descriptors)
        fitnesses = repertoire.fitnesses[cells, 0]
        target = jnp.where(held & scores.finite, cells, self.fitnesses.shape[0])
        return EliteGradients(
            gradients=self.gradients.at[target].set(scores.gradients, mode="drop"),
            fitnesses=self.fitnesses.at[target].set(fitnesses, mode="drop"),
            rejected=self.rejected + jnp.sum(~scores.finite, dtype=jnp.int32),
        )

    def known(self, repertoire: Repertoire) -> jax.Array:
        """Returns whether a cell has an elite with known gradients (cells,)."""
        filled = repertoire.fitnesses[:, 0] > -jnp.inf
        return filled & (repertoire.fitnesses[:, 0] == self.fitnesses)

    def at(self, repertoire: Repertoire, cells: jax.Array) -> jax.Array:
        """Returns gradients (N, 1 + D, size) of elites of N cells, zero if unknown."""
        known = self.known(repertoire)[cells]
        return jnp.where(known[:, None, None], self.gradients[cells], 0)

    def select(
        self,
        repertoire: Repertoire,
        key: jax.Array,
        count: int,
        selector: Selector | None = None,
    ) -> jax.Array:
        """Draws cells whose elites have gradients, or any filled cells if none has.

        Args:
            repertoire: Repertoire of the elites.
            key: Random key.
            count: Number of parents.
            selector: Selector of QDax; ``None``: uniform, with replacement.

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
        """Sets the batch size and the selection of parents.

        Args:
            batch_size: Individuals emitted in one iteration.
            selector: Selector of QDax; ``None``: uniform, with replacement.

        Raises:
            TypeError: ``selector`` is not an instance of QDax's ``Selector``.
            ValueError: The batch is empty.
        """
        checks.integer("batch_size", batch_size, most=None)
        allowed = "an instance of a selector of QDax, such as UniformSelector()"
        checks.instance("selector", selector, Selector, allowed, optional=True)
        self._batch_size = batch_size
        self._selector = selector

    @property
    def batch_size(self) -> int:
        """Individuals emitted in one iteration."""
        return self._batch_size

    @property
    def use_all_data(self) -> bool:
        """Whether elites of other emitters can be parents: always true."""
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
        """Stores the gradients of the initial elites.

        Raises:
            GradientsError: ``extra_scores`` has no gradients with the right shape.
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
        """Stores the gradients of the new elites.

        Raises:
            GradientsError: ``extra_scores`` has no gradients with the right shape.
        """
        scores = read_scores(genotypes, fitnesses, descriptors, extra_scores)
        return emitter_state.add(repertoire, scores)


def check_steps(steps: int, scoring_function: ScoringFunction | None) -> None:
    """Checks the number of gradient steps of an offspring.

    Raises:
        ValueError: It is below 1, or it needs a missing scoring function.
    """
    checks.integer("steps", steps, most=None)
    if steps > 1 and scoring_function is None:
        raise ValueError(message("steps", steps, "1 without a scoring_function"))
