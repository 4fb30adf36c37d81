"""The gradient of fitness and descriptor of whole episodes."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp

from newton_qd.envs.state import select
from newton_qd.gradients.episode import Outcome, Policy, make_episode
from newton_qd.gradients.flow import GradientOptions


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class EpisodeGradients:
    """Fitness and descriptor of N episodes, and their gradients.

    Attributes:
        fitnesses: (N,) sums of the rewards up to the first ``done``; ``-inf`` where
            ``faulty``.
        descriptors: (N, D) descriptors.
        gradients: As the genotypes, every leaf (N, 1 + D, ...): of the fitness, then
            of each component of the descriptor; exactly 0 where ``faulty`` or
            ``overflowed``, and finite everywhere.
        faulty: (N,) whether the world was at fault before the episode ended.
        overflowed: (N, 1 + D) whether the world was sound and the gradient was not
            finite: it grew beyond the numbers, or the policy has none there.
    """

    fitnesses: jax.Array
    descriptors: jax.Array
    gradients: Any
    faulty: jax.Array
    overflowed: jax.Array


EpisodeGradient: TypeAlias = Callable[[Any, jax.Array], EpisodeGradients]
"""Maps N genotypes and the key of the reset that they share to their gradients."""

DirectionalGradient: TypeAlias = Callable[[Any, jax.Array, jax.Array], EpisodeGradients]
"""Maps N genotypes, directions (N, R, 1 + D) and a key to R gradients of each."""


def make_episode_gradient(
    env: Any,
    policy: Policy | None,
    descriptor_extractor: Callable[[Any, jax.Array], jax.Array] | None,
    *,
    episode_length: int,
    unravel: Callable[[Any], Any] = lambda genotype: genotype,
    options: GradientOptions | None = None,
) -> EpisodeGradient:
    """Builds the gradient of an episode, of a policy or of open-loop actions.

    All rows of the Jacobian go back through the episode at once: a launch of the
    physics' adjoint has N (1 + D) worlds.

    Args:
        env: Environment of one world without auto-reset. Its state descriptor needs a
            gradient: see :func:`~newton_qd.gradients.with_smooth_descriptor`.
        policy: As in :func:`~newton_qd.gradients.make_episode`; ``None``: the
            genotypes are the actions, (N, episode_length, nu).
        descriptor_extractor: Reads the descriptor of an episode; ``None``: it is empty,
            and the fitness alone has a gradient.
        episode_length: Control steps; a reward counts up to the first ``done``.
        unravel: Maps a genotype to the parameters of the policy.
        options: Windows, clipping, discounting and memory; ``None``: exact, one state
            kept per control step.

    Returns:
        Function of genotypes, any pytree whose leaves have N in front, and of one key
        of the reset, or one state that all episodes begin from.
    """
    run = make_episode(
        env,
        policy,
        descriptor_extractor,
        episode_length=episode_length,
        unravel=unravel,
        options=options or GradientOptions(),
    )
    return jax.vmap(functools.partial(_differentiated, run, None), in_axes=(0, None))


def make_directional_gradient(
    env: Any,
    policy: Policy | None,
    descriptor_extractor: Callable[[Any, jax.Array], jax.Array],
    *,
    episode_length: int,
    unravel: Callable[[Any], Any] = lambda genotype: genotype,
    options: GradientOptions | None = None,
) -> DirectionalGradient:
    """Builds the gradient of weighted sums of an episode's fitness and descriptor.

    What :func:`make_episode_gradient` gives, multiplied by directions, for the price
    of as many rows as there are directions: a launch of the physics' adjoint has N R
    worlds.

    Args:
        env: As in :func:`make_episode_gradient`; so are all others.
        policy: Maps parameters and an observation to an action, or ``None``.
        descriptor_extractor: Reads the descriptor of an episode.
        episode_length: Control steps.
        unravel: Maps a genotype to the parameters of the policy.
        options: Windows, clipping, discounting and memory.

    Returns:
        Function of genotypes, directions (N, R, 1 + D), whose first column weights the
        fitness, and one key; the rows (N, R, ...) of its gradients are those of the
        weighted sums.
    """
    run = make_episode(
        env,
        policy,
        descriptor_extractor,
        episode_length=episode_length,
        unravel=unravel,
        options=options or GradientOptions(),
    )

    def gradient(
        genotypes: Any, directions: jax.Array, key: jax.Array
    ) -> EpisodeGradients:
        one = functools.partial(_differentiated, run)
        return jax.vmap(one, in_axes=(0, 0, None))(directions, genotypes, key)

    return gradient


def _differentiated(
    run: Callable[[Any, jax.Array], Outcome],
    directions: jax.Array | None,
    genotype: Any,
    key: jax.Array,
) -> EpisodeGradients:
    """One episode with its gradient along directions (R, 1 + D); ``None``: each."""

    def values(genotype: Any) -> tuple[jax.Array, Outcome]:
        outcome = run(genotype, key)
        return jnp.append(outcome.fitness, outcome.descriptor), outcome

    rows, pull, outcome = jax.vjp(values, genotype, has_aux=True)
    if directions is None:
        directions = jnp.eye(rows.size, dtype=rows.dtype)
    (gradients,) = jax.vmap(pull)(directions.astype(rows.dtype))
    sound = finite_rows(gradients)
    zeros = jax.tree.map(jnp.zeros_like, gradients)
    return EpisodeGradients(
        fitnesses=jnp.where(outcome.faulty, -jnp.inf, outcome.fitness),
        descriptors=outcome.descriptor,
        gradients=select(sound & ~outcome.faulty, gradients, zeros),
        faulty=outcome.faulty,
        overflowed=~sound & ~outcome.faulty,
    )


def finite_rows(tree: Any) -> jax.Array:
    """Whether all numbers of each row are finite, (n,) for leaves (n, ...)."""
    leaves = jax.tree.leaves(tree)
    finite = [jnp.isfinite(x).reshape(x.shape[0], -1).all(axis=1) for x in leaves]
    return jnp.stack(finite).all(axis=0)
