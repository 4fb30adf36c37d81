"""Iso+line variations towards fitter elites."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from qdax.core.emitters.emitter import Emitter

from newton_qd import checks
from newton_qd.qd.emitters.cells import draw_cells
from newton_qd.types import ExtraScores, Genotype, PyTree, Repertoire, RNGKey


class TournamentEmitter(Emitter):
    """Varies elites, each towards the winner of a tournament.

    The first parent is drawn uniformly from the elites, as in MAP-Elites. So every cell
    has offspring. The second one is the fittest of several elites that are drawn
    uniformly (tournament selection, Goldberg and Deb 1991). The state of this emitter
    is empty.

    Args:
        vary: Variation of first and second parents with a key, such as QDax's
            ``isoline_variation``.
        batch_size: Offspring in one iteration.
        tournament: Elites in a tournament.

    Raises:
        ValueError: A number is out of its range.
    """

    def __init__(
        self,
        vary: Callable[[Genotype, Genotype, RNGKey], Genotype],
        *,
        batch_size: int,
        tournament: int,
    ) -> None:
        checks.integer("batch_size", batch_size, most=None)
        checks.integer("tournament", tournament, most=None)
        self._vary = vary
        self._batch_size = batch_size
        self._tournament = tournament

    @property
    def batch_size(self) -> int:
        """Individuals emitted in one iteration."""
        return self._batch_size

    def emit(
        self, repertoire: Repertoire, emitter_state: PyTree, key: RNGKey
    ) -> tuple[Genotype, ExtraScores]:
        """Draws parents and varies them."""
        del emitter_state
        first_key, second_key, vary_key = jax.random.split(key, 3)
        fitnesses = repertoire.fitnesses[:, 0]
        filled = fitnesses > -jnp.inf
        first = draw_cells(first_key, filled, self._batch_size)
        entrants = draw_cells(second_key, filled, self._batch_size * self._tournament)
        entrants = entrants.reshape(self._batch_size, self._tournament)
        winner = jnp.argmax(fitnesses[entrants], axis=1)
        second = jnp.take_along_axis(entrants, winner[:, None], axis=1)[:, 0]

        def of(cells: jax.Array) -> Genotype:
            return jax.tree.map(lambda leaf: leaf[cells], repertoire.genotypes)

        return self._vary(of(first), of(second), vary_key), {}
