"""Covariance matrix adaptation MAP-annealing via a gradient arborescence."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.typing import ArrayLike

from newton_qd.qd.annealed_repertoire import AnnealedRepertoire
from newton_qd.qd.emitters.arborescence import ArborescenceEmitter
from newton_qd.qd.emitters.gradients import ScoringFunction
from newton_qd.qd.emitters.restarts import RestartRule


class CMAMAEGAEmitter(ArborescenceEmitter):
    """CMA-ES searches for the steps along the gradients that exceed thresholds.

    Fontaine & Nikolaidis, "Covariance Matrix Adaptation MAP-Annealing", GECCO 2023,
    algorithm 1 and appendix on CMA-MAEGA: offspring are ordered by f - t, their
    fitness above the threshold of their cell. Needs an ``AnnealedRepertoire``.
    """

    def __init__(
        self,
        scoring_function: ScoringFunction,
        *,
        sigma_g: float,
        batch_size: int = 36,
        num_emitters: int = 1,
        optimizer: optax.GradientTransformation | None = None,
        restart_rule: RestartRule = RestartRule.BASIC,
        restart_period: int | None = None,
        start: ArrayLike | None = None,
    ) -> None:
        """Sets up the search as ``ArborescenceEmitter`` describes."""
        super().__init__(
            scoring_function,
            sigma_g=sigma_g,
            batch_size=batch_size,
            num_emitters=num_emitters,
            optimizer=optimizer,
            restart_rule=restart_rule,
            restart_period=restart_period,
            start=start,
        )

    def _bars(self, repertoire: Any) -> jax.Array:
        if not isinstance(repertoire, AnnealedRepertoire):
            raise TypeError(
                "repertoire must be an AnnealedRepertoire, whose cells have "
                f"thresholds, got {type(repertoire).__name__}: give MAPElites its "
                "init as repertoire_init"
            )
        return repertoire.thresholds

    def _rank(
        self, fitnesses: jax.Array, bars: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        return jnp.zeros(fitnesses.shape, jnp.int32), fitnesses - bars
