"""Emitters with an annealed archive in a loop with an elitist archive."""

from __future__ import annotations

from typing import Any

import jax
from qdax.core.emitters.emitter import Emitter, EmitterState

from newton_qd.qd.emitters.annealed_repertoire import (
    AnnealedRepertoire,
    check_annealing,
)
from newton_qd.types import ExtraScores, Genotype, PyTree, Repertoire


class AnnealedState(EmitterState):
    """An annealed archive, and the state of its emitter.

    Attributes:
        repertoire: The archive.
        emitter: State of the emitter.
    """

    repertoire: AnnealedRepertoire
    emitter: Any


class OnAnnealedRepertoire(Emitter):
    """Gives an emitter an annealed archive instead of the loop's archive.

    The loop's archive stays elitist. It is the ``result`` of the annealed archive.
    """

    def __init__(
        self, emitter: Emitter, *, learning_rate: float, threshold_min: float
    ) -> None:
        """Sets the annealing.

        Args:
            emitter: Emitter that needs an annealed archive.
            learning_rate: Learning rate of the thresholds, in [0, 1].
            threshold_min: First threshold of every cell, in units of the fitness.

        Raises:
            ValueError: A setting of the thresholds is out of its range.
        """
        check_annealing(learning_rate, threshold_min)
        self._emitter = emitter
        self._learning_rate = learning_rate
        self._threshold_min = threshold_min

    @property
    def batch_size(self) -> int:
        """Individuals emitted in one iteration."""
        return self._emitter.batch_size

    def init(
        self,
        key: jax.Array,
        repertoire: Repertoire,
        genotypes: Genotype,
        fitnesses: jax.Array,
        descriptors: jax.Array,
        extra_scores: ExtraScores,
    ) -> AnnealedState:
        """Makes the annealed archive from the initial population."""
        annealed = AnnealedRepertoire.init(
            genotypes,
            fitnesses,
            descriptors,
            repertoire.centroids,
            learning_rate=self._learning_rate,
            threshold_min=self._threshold_min,
        )
        state = self._emitter.init(
            key, annealed, genotypes, fitnesses, descriptors, extra_scores
        )
        return AnnealedState(annealed, state)

    def emit(
        self, repertoire: Repertoire, emitter_state: PyTree, key: jax.Array
    ) -> tuple[Genotype, ExtraScores]:
        """Emits individuals from the annealed archive."""
        del repertoire
        return self._emitter.emit(emitter_state.repertoire, emitter_state.emitter, key)

    def state_update(
        self,
        emitter_state: PyTree,
        repertoire: Repertoire = None,
        genotypes: Genotype | None = None,
        fitnesses: jax.Array | None = None,
        descriptors: jax.Array | None = None,
        extra_scores: ExtraScores | None = None,
    ) -> AnnealedState:
        """Adds a generation to the annealed archive, and updates the emitter."""
        del repertoire
        annealed = emitter_state.repertoire.add(genotypes, descriptors, fitnesses)
        state = self._emitter.state_update(
            emitter_state.emitter,
            annealed,
            genotypes,
            fitnesses,
            descriptors,
            extra_scores,
        )
        return AnnealedState(annealed, state)
