"""Two emitters that have generations in turn."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp

from newton_qd.types import ExtraScores, PyTree, Repertoire

if TYPE_CHECKING:
    from qdax.core.emitters.emitter import Emitter


class InTurnState(NamedTuple):
    """State of two emitters that have generations in turn.

    Attributes:
        first: State of the first emitter.
        second: State of the second one.
        generation: () generations so far.
    """

    first: PyTree
    second: PyTree
    generation: jax.Array


class InTurn:
    """Emitters that have generations in turn; the second remembers all of them.

    Args:
        first: Emitter with the first generations.
        second: Emitter with most of the others; ``remember`` tells it of generations
            that are not its own.
        alone: Generations of the first emitter before the first one of the second.
        every: After that, one of so many generations is one of the first; 0: none.
    """

    def __init__(
        self, first: Emitter, second: Emitter, *, alone: int, every: int
    ) -> None:
        self._first = first
        self._second = second
        self._alone = alone
        self._every = every

    def _is_first(self, generation: jax.Array) -> jax.Array:
        turn = generation < self._alone
        if self._every:
            turn = turn | (generation % self._every == 0)
        return turn

    def init(self, key: jax.Array, **told: PyTree) -> InTurnState:
        """Returns the state before the second generation."""
        first, second = jax.random.split(key)
        return InTurnState(
            self._first.init(first, **told),
            self._second.init(second, **told),
            jnp.zeros((), jnp.int32),
        )

    def emit(
        self, repertoire: Repertoire, state: InTurnState, key: jax.Array
    ) -> tuple[jax.Array, ExtraScores]:
        """Returns weights (N, size) and the emitter's data about them."""

        def one(emitter: Emitter, of: int) -> tuple[jax.Array, ExtraScores]:
            return emitter.emit(repertoire, state[of], key)

        known = jax.eval_shape(lambda: one(self._first, 0)[1])
        other = jax.eval_shape(lambda: one(self._second, 1)[1])

        def all_of(
            emitted: tuple[jax.Array, ExtraScores],
        ) -> tuple[jax.Array, ExtraScores]:
            zeros = {
                name: jnp.zeros(leaf.shape, leaf.dtype)
                for name, leaf in {**known, **other}.items()
            }
            return emitted[0], {**zeros, **emitted[1]}

        return jax.lax.cond(
            self._is_first(state.generation),
            lambda: all_of(one(self._first, 0)),
            lambda: all_of(one(self._second, 1)),
        )

    def state_update(self, emitter_state: InTurnState, **told: PyTree) -> InTurnState:
        """Learns from a generation."""
        first, second, generation = emitter_state

        def actors() -> tuple[PyTree, PyTree]:
            return (
                self._first.state_update(first, **told),
                self._second.remember(second, **told),
            )

        def follower() -> tuple[PyTree, PyTree]:
            return first, self._second.state_update(second, **told)

        first, second = jax.lax.cond(self._is_first(generation), actors, follower)
        return InTurnState(first, second, generation + 1)
