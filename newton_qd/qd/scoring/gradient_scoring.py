"""Scoring functions that also return the gradients of fitness and descriptor."""

from __future__ import annotations

from collections.abc import Callable

import jax

from newton_qd import types
from newton_qd.gradients.exact import EpisodeGradient
from newton_qd.gradients.factories import make_episode_gradient
from newton_qd.gradients.flow import GradientOptions
from newton_qd.gradients.scores import gradient_scores
from newton_qd.qd.scoring.rollout import Policy
from newton_qd.qd.scoring.task import Task
from newton_qd.types import ExtraScores, Genotype, RNGKey, ScoringFunction


def make_gradient_scoring_function(
    task: Task,
    policy: Policy | types.PolicyFunction | None,
    episode_length: int,
    options: GradientOptions | None = None,
    *,
    estimator: Callable[..., EpisodeGradient] = make_episode_gradient,
) -> ScoringFunction:
    """Builds the function that evaluates a batch of individuals with gradients.

    Deprecated: use ``episode.scoring(episode.gradient)`` of an
    :class:`~newton_qd.gradients.Episode`.

    This is :func:`~newton_qd.qd.make_scoring_function` with gradients in the layout of
    QDax's emitters. Their last axis has the fitness first, then each component of the
    descriptor.

    Args:
        task: Environment and descriptor. A descriptor of feet contacts needs
            :func:`~newton_qd.gradients.with_smooth_descriptor` to have a gradient.
        policy: A :class:`~newton_qd.qd.Policy`, with flat genotypes. Or any function of
            a pytree genotype and an observation, such as the ``apply`` of a module of
            Flax. ``None``: genotypes are the actions.
        episode_length: Control steps of an evaluation.
        options: Windows, clipping, discounting and memory of the gradients.
        estimator: Builds the gradient, from the arguments of
            :func:`~newton_qd.gradients.make_episode_gradient`.

    Returns:
        Function of genotypes (N, ...) and a key for the reset. It returns fitnesses
        (N,), descriptors (N, D) and a dictionary: ``gradients``, every leaf of the
        genotypes with an axis 1 + D at the end; ``normalized_grads``, the same with
        Euclidean norm 1 over a genotype (0 stays 0); ``faulty`` (N,) and ``overflowed``
        (N, 1 + D), which mark gradients that were set to 0. The fitness of a faulty
        individual is ``-inf``. With a :class:`~newton_qd.qd.Policy`, the function
        raises ``ValueError`` for genotypes that are not weights of this policy.

    Raises:
        TypeError: The environment, the policy or the options have the wrong type.
        ValueError: ``episode_length`` is not an integer from 1.
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
        genotypes: Genotype, key: RNGKey
    ) -> tuple[jax.Array, jax.Array, ExtraScores]:
        if isinstance(policy, Policy):
            genotypes = policy.weights(genotypes)
        return gradient_scores(gradient(genotypes, key))

    return score
