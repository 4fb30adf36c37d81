"""Adds a part to the generation of an emitter that learns from all of it."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from newton_qd.types import ExtraScores, PyTree, Repertoire


class Beside:
    """Emits the individuals of an emitter, then those of another one.

    Both are told of the whole generation. So the first one learns from the individuals
    of the other, too.

    Args:
        emitter: Emitter that learns from a generation of any size, and whose own
            individuals are the first ones.
        other: Emitter that does not ask which individuals are its own.
    """

    def __init__(self, emitter: Any, other: Any) -> None:
        self._parts = emitter, other

    def init(self, key: jax.Array, **told: PyTree) -> PyTree:
        """Returns the states before the second generation."""
        keys = jax.random.split(key, len(self._parts))
        return tuple(
            part.init(key=own, **told)
            for part, own in zip(self._parts, keys, strict=True)
        )

    def emit(
        self, repertoire: Repertoire, state: PyTree, key: jax.Array
    ) -> tuple[jax.Array, ExtraScores]:
        """Returns weights (N, size) and the data of both emitters about them."""
        keys = jax.random.split(key, len(self._parts))
        found = [
            part.emit(repertoire, own, own_key)
            for part, own, own_key in zip(self._parts, state, keys, strict=True)
        ]
        weights = jnp.concatenate([part for part, _ in found])
        return weights, {**found[0][1], **found[1][1]}

    def state_update(self, emitter_state: PyTree, **told: PyTree) -> PyTree:
        """Tells both emitters of a generation."""
        return tuple(
            part.state_update(emitter_state=own, **told)
            for part, own in zip(self._parts, emitter_state, strict=True)
        )
