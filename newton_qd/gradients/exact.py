"""The gradient of fitness and descriptor of one episode, row by row."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp

from newton_qd.envs.state import select
from newton_qd.gradients.outcome import Outcome
from newton_qd.moved import moved_name
from newton_qd.types import Genotype, PyTree, RNGKey

_MOVED = {
    "make_directional_gradient": "newton_qd.gradients.make_directional_gradient",
    "make_episode_gradient": "newton_qd.gradients.make_episode_gradient",
}


def __getattr__(name: str) -> Any:
    """Finds what has left this module."""
    return moved_name(__name__, name, _MOVED)


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
    gradients: Genotype
    faulty: jax.Array
    overflowed: jax.Array


EpisodeGradient: TypeAlias = Callable[[Genotype, RNGKey], EpisodeGradients]
"""Maps N genotypes and the key of the reset that they share to their gradients."""

DirectionalGradient: TypeAlias = Callable[
    [Genotype, jax.Array, RNGKey], EpisodeGradients
]
"""Maps N genotypes, weights (N, R, 1 + D) and a key to R gradients of each."""


def differentiate(
    run: Callable[[Genotype], Outcome], genotype: Genotype, weights: jax.Array | None
) -> EpisodeGradients:
    """One episode with the gradients of fitness and descriptor.

    Args:
        run: The episode, as a function of the genotype.
        genotype: Whose policy acts, or the actions.
        weights: (R, 1 + D) one weighted sum of fitness and descriptor in each row;
            ``None``: the fitness and each component of the descriptor by themselves.
    """

    def values(genotype: Genotype) -> tuple[jax.Array, Outcome]:
        outcome = run(genotype)
        return jnp.append(outcome.fitness, outcome.descriptor), outcome

    rows, pull, outcome = jax.vjp(values, genotype, has_aux=True)
    if weights is None:
        weights = jnp.eye(rows.size, dtype=rows.dtype)
    (gradients,) = jax.vmap(pull)(weights.astype(rows.dtype))
    sound = finite_rows(gradients)
    zeros = jax.tree.map(jnp.zeros_like, gradients)
    return EpisodeGradients(
        fitnesses=outcome.admitted_fitness,
        descriptors=outcome.descriptor,
        gradients=select(sound & ~outcome.faulty, gradients, zeros),
        faulty=outcome.faulty,
        overflowed=~sound & ~outcome.faulty,
    )


def finite_rows(tree: PyTree) -> jax.Array:
    """Whether all numbers of each row are finite, (n,) for leaves (n, ...)."""
    leaves = jax.tree.leaves(tree)
    finite = [jnp.isfinite(x).reshape(x.shape[0], -1).all(axis=1) for x in leaves]
    return jnp.stack(finite).all(axis=0)
