"""Scores of episodes for QDax: fitnesses, descriptors and a dictionary."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd.gradients.exact import EpisodeGradients
from newton_qd.gradients.flow import divisor, tree_largest, tree_norm
from newton_qd.gradients.outcome import Outcome
from newton_qd.types import ExtraScores, Genotype


def scores(outcome: Outcome) -> tuple[jax.Array, jax.Array, ExtraScores]:
    """Returns scores of N episodes; the dictionary has their transitions, if any."""
    steps = outcome.transitions
    extra = {"transitions": steps} if steps else {}
    return outcome.fitness, outcome.descriptor, extra


def gradient_scores(
    found: EpisodeGradients,
) -> tuple[jax.Array, jax.Array, ExtraScores]:
    """Returns scores of N episodes with their gradients in QDax's layout.

    Returns:
        Fitnesses (N,), descriptors (N, D) and a dictionary: ``gradients``, every leaf
        of the genotypes with an axis 1 + D at the end, first the fitness;
        ``normalized_grads``, the same with Euclidean norm 1 over a genotype (0 stays
        0); ``faulty`` (N,) and ``overflowed`` (N, 1 + D).
    """
    gradients = _rows_last(found.gradients)
    extra: ExtraScores = {
        "gradients": gradients,
        "normalized_grads": unit_rows(gradients),
        "faulty": found.faulty,
        "overflowed": found.overflowed,
    }
    return found.fitnesses, found.descriptors, extra


def unit_rows(gradients: Genotype) -> Genotype:
    """Returns gradients (N, ..., R) with norm 1 over a genotype; 0 stays 0."""
    rows = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 1), gradients)
    return _rows_last(jax.vmap(jax.vmap(_unit))(rows))


def _unit(gradient: Genotype) -> Genotype:
    """Returns a gradient of norm 1, or 0 where it is 0."""
    # scaled twice, because the norm of large numbers may overflow
    for norm in (tree_largest, tree_norm):
        size = divisor(norm(gradient))
        gradient = jax.tree.map(lambda x, size=size: x / size, gradient)
    return gradient


def _rows_last(gradients: Genotype) -> Genotype:
    return jax.tree.map(lambda x: jnp.moveaxis(x, 1, -1), gradients)
