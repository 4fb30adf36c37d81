"""Scoring functions that also return the gradients of fitness and descriptor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from newton_qd.gradients.exact import EpisodeGradient, EpisodeGradients
from newton_qd.gradients.factories import make_episode_gradient
from newton_qd.gradients.flow import GradientOptions, tree_largest, tree_norm
from newton_qd.qd.scoring.rollout import Policy, ScoringFunction
from newton_qd.qd.scoring.task import Task


def make_gradient_scoring_function(
    task: Task,
    policy: Policy | Callable[[Any, jax.Array], jax.Array] | None,
    episode_length: int,
    options: GradientOptions | None = None,
    *,
    estimator: Callable[..., EpisodeGradient] = make_episode_gradient,
) -> ScoringFunction:
    """Builds the function that evaluates a batch of individuals with gradients.

    :func:`~newton_qd.qd.make_scoring_function` with gradients, laid out for QDax's
    emitters: their last axis has the fitness first, then each descriptor component.

    Args:
        task: Environment and descriptor. A descriptor of feet contacts has a gradient
            where :func:`~newton_qd.gradients.with_smooth_descriptor` gave it one.
        policy: A :class:`~newton_qd.qd.Policy`, with flat genotypes; any function of a
            pytree genotype and an observation, as the ``apply`` of a module of Flax or
            ``lambda module, obs: module(obs)``; ``None``: genotypes are the actions.
        episode_length: Control steps of an evaluation.
        options: Windows, clipping, discounting and memory of the gradients.
        estimator: Builds the gradient, from the arguments of
            :func:`~newton_qd.gradients.make_episode_gradient`.

    Returns:
        Function of genotypes (N, ...) and a key for the reset; returns fitnesses (N,),
        descriptors (N, D) and a dict: ``gradients``, every leaf of the genotypes with
        an axis of 1 + D behind; ``normalized_grads``, the same with Euclidean norm 1
        over a genotype, or 0 where the gradient is; ``faulty`` (N,) and ``overflowed``
        (N, 1 + D), whose gradients were set to 0. The fitness of a faulty individual
        is ``-inf``. With a :class:`~newton_qd.qd.Policy` it raises ``ValueError`` for
        genotypes that are not weights of it.
    """
    flat = isinstance(policy, Policy)
    unravel = {"unravel": policy.unravel} if flat else {}
    gradient = estimator(
        task.env,
        policy.apply if flat else policy,
        task.descriptor_extractor,
        episode_length=episode_length,
        options=options,
        **unravel,
    )

    def score(
        genotypes: Any, key: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, Any]]:
        if isinstance(policy, Policy):
            genotypes = policy.weights(genotypes)
        result: EpisodeGradients = gradient(genotypes, key)
        return result.fitnesses, result.descriptors, _extra_scores(result)

    return score


def _extra_scores(result: EpisodeGradients) -> dict[str, Any]:
    """Returns gradients in QDax's layout, and what befell them."""
    unit = jax.vmap(jax.vmap(_unit))(result.gradients)
    return {
        "gradients": _rows_last(result.gradients),
        "normalized_grads": _rows_last(unit),
        "faulty": result.faulty,
        "overflowed": result.overflowed,
    }


def _unit(gradient: Any) -> Any:
    """Returns a gradient of norm 1, or 0 where it is 0."""
    # twice: the norm of large numbers may be beyond the numbers
    for norm in (tree_largest, tree_norm):
        size = norm(gradient)
        divisor = jnp.where(size == 0, jnp.ones_like(size), size)
        gradient = jax.tree.map(lambda x, d=divisor: x / d, gradient)
    return gradient


def _rows_last(gradients: Any) -> Any:
    return jax.tree.map(lambda x: jnp.moveaxis(x, 1, -1), gradients)
