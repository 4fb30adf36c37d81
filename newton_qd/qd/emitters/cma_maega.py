"""Covariance matrix adaptation MAP-annealing via a gradient arborescence."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd import checks
from newton_qd.qd.emitters.annealed_repertoire import AnnealedRepertoire
from newton_qd.qd.emitters.arborescence import ArborescenceEmitter
from newton_qd.qd.emitters.restarts import RestartRule
from newton_qd.types import Repertoire


class CMAMAEGAEmitter(ArborescenceEmitter):
    """CMA-ES searches for steps along the gradients that exceed thresholds.

    Fontaine & Nikolaidis, "Covariance Matrix Adaptation MAP-Annealing", GECCO 2023:
    offspring are sorted by f - t, their fitness minus the threshold of their cell. The
    emitter needs an ``AnnealedRepertoire``.
    """

    default_restart_rule = RestartRule.BASIC

    def _bars(self, repertoire: Repertoire) -> jax.Array:
        allowed = (
            "an AnnealedRepertoire, whose cells have thresholds: give MAPElites its "
            "init as repertoire_init"
        )
        checks.instance("repertoire", repertoire, AnnealedRepertoire, allowed)
        return repertoire.thresholds

    def _rank(
        self, fitnesses: jax.Array, bars: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        return jnp.zeros(fitnesses.shape, jnp.int32), fitnesses - bars
