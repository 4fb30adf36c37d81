"""Adapter for emitters of QDax that learn from the descriptor of an episode."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from newton_qd.types import ExtraScores, PyTree, Repertoire

if TYPE_CHECKING:
    from qdax.core.emitters.emitter import Emitter


class EachEpisode:
    """Tells an emitter of every episode what it tells of an individual.

    With several start states, the descriptor of an individual is the mean or median of
    its episodes. An emitter that learns from transitions needs the descriptor that
    their own episode reached.

    Args:
        emitter: Emitter that proposes individuals.
        learner: The same emitter for generations that are ``starts`` times as large.
        starts: Start states of each individual.
    """

    def __init__(self, emitter: Emitter, learner: Emitter, starts: int) -> None:
        self._emitter = emitter
        self._learner = learner
        self._starts = starts

    def init(self, key: jax.Array, **told: PyTree) -> PyTree:
        """Returns the state before the second generation."""
        return self._learner.init(key=key, **self._episodes(told))

    def emit(
        self, repertoire: Repertoire, state: PyTree, key: jax.Array
    ) -> tuple[PyTree, ExtraScores]:
        """Returns genotypes and the emitter's data about them."""
        return self._emitter.emit(repertoire, state, key)

    def state_update(self, emitter_state: PyTree, **told: PyTree) -> PyTree:
        """Learns from all episodes of a generation."""
        return self._learner.state_update(emitter_state, **self._episodes(told))

    def _episodes(self, told: dict[str, PyTree]) -> dict[str, PyTree]:
        """Returns what is told, with an individual in place of each episode.

        The episodes of an individual follow each other.
        """
        extra = told["extra_scores"]

        def apart(leaf: jax.Array) -> jax.Array:
            return leaf.reshape(len(leaf) * self._starts, -1, *leaf.shape[2:])

        def repeated(leaf: jax.Array) -> jax.Array:
            return jnp.repeat(leaf, self._starts, axis=0)

        descriptors = extra["episode_descriptors"]
        episodes = {"transitions": jax.tree.map(apart, extra["transitions"])}
        if "desc_prime" in extra:  # what individuals of critic and actor were made for
            episodes["desc_prime"] = repeated(extra["desc_prime"])
        return {
            **told,
            "genotypes": jax.tree.map(repeated, told["genotypes"]),
            "fitnesses": repeated(told["fitnesses"]),
            "descriptors": descriptors.reshape(-1, descriptors.shape[-1]),
            "extra_scores": episodes,
        }
