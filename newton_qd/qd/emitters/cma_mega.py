"""Covariance matrix adaptation MAP-Elites via a gradient arborescence."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd.qd.emitters.arborescence import ArborescenceEmitter
from newton_qd.qd.emitters.ranking import IMPROVED, NEW, WORSE
from newton_qd.qd.emitters.restarts import RestartRule
from newton_qd.types import Repertoire


class CMAMEGAEmitter(ArborescenceEmitter):
    """CMA-ES searches for steps along the gradients that improve the archive.

    Fontaine & Nikolaidis, "Differentiable Quality Diversity", NeurIPS 2021: offspring
    for empty cells come first, then offspring that improve an elite. Both groups are
    sorted by improvement (two-stage improvement ranking, Fontaine et al. 2020).
    """

    default_restart_rule = RestartRule.NO_IMPROVEMENT

    def _bars(self, repertoire: Repertoire) -> jax.Array:
        return repertoire.fitnesses[:, 0]

    def _rank(
        self, fitnesses: jax.Array, bars: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        empty = bars == -jnp.inf
        improvement = fitnesses - jnp.where(empty, 0, bars)
        classes = jnp.where(fitnesses > bars, IMPROVED, WORSE)
        return jnp.where(empty, NEW, classes), improvement
