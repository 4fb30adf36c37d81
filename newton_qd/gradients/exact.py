"""The gradient of fitness and descriptor of one episode, row by row."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp

from newton_qd.checks import Fact, message
from newton_qd.envs.state import select
from newton_qd.gradients.outcome import Outcome
from newton_qd.moved import moved_name
from newton_qd.physics.explicit_mesh import split_as
from newton_qd.types import Genotype, PyTree, RNGKey

_MOVED = {
    "make_directional_gradient": "newton_qd.gradients.make_directional_gradient",
    "make_episode_gradient": "newton_qd.gradients.make_episode_gradient",
}


def __getattr__(name: str) -> Any:
    """Returns a moved object by its old name."""
    return moved_name(__name__, name, _MOVED)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class EpisodeGradients:
    """Fitness and descriptor of N episodes, and their gradients.

    Attributes:
        fitnesses: (N,) sums of the rewards up to the first ``done``; ``-inf`` if
            ``faulty``.
        descriptors: (N, D) descriptors.
        gradients: Pytree like the genotypes, leaves (N, 1 + D, ...): first of the
            fitness, then of each component of the descriptor. Always finite, and
            exactly 0 if ``faulty`` or ``overflowed``.
        faulty: (N,) whether the world had a fault before the episode ended.
        overflowed: (N, 1 + D) whether the world had no fault but the gradient was not
            finite. It was too large for the dtype, or the policy has no gradient there.
    """

    fitnesses: jax.Array
    descriptors: jax.Array
    gradients: Genotype
    faulty: jax.Array
    overflowed: jax.Array


EpisodeGradient: TypeAlias = Callable[[Genotype, RNGKey], EpisodeGradients]
"""Maps N genotypes and the key of their shared reset to their gradients."""

DirectionalGradient: TypeAlias = Callable[
    [Genotype, jax.Array, RNGKey], EpisodeGradients
]
"""Maps N genotypes, weights (N, R, 1 + D) and a key to R gradients of each."""


def differentiate(
    run: Callable[[Genotype], Outcome], genotype: Genotype, weights: jax.Array | None
) -> EpisodeGradients:
    """Returns one episode with the gradients of fitness and descriptor.

    Args:
        run: The episode, as a function of the genotype.
        genotype: Genotype of the policy, or the actions.
        weights: (R, 1 + D) weights of one sum of fitness and descriptor in each row;
            ``None``: no sums, but the fitness and each component of the descriptor.

    Raises:
        TypeError: A genotype is not of floating point, so it has no gradient.
        ValueError: The weights have another number of columns.
    """
    require_floating(genotype)

    def values(genotype: Genotype) -> tuple[jax.Array, Outcome]:
        outcome = run(genotype)
        parts = [outcome.fitness, outcome.descriptor]
        fitness, descriptor = split_as(parts, parts)
        return jnp.append(fitness, descriptor), outcome

    rows, pull, outcome = jax.vjp(values, genotype, has_aux=True)
    if weights is None:
        weights = jnp.eye(rows.size, dtype=rows.dtype)
    if weights.shape[1] != rows.size:
        given, allowed = Fact(f"{weights.shape[1]} columns"), f"1 + D = {rows.size}"
        raise ValueError(message("weights", given, allowed))
    weights = split_as([rows], weights.astype(rows.dtype))
    (gradients,) = jax.vmap(pull)(weights)
    sound = finite_rows(gradients)
    zeros = jax.tree.map(jnp.zeros_like, gradients)
    return EpisodeGradients(
        fitnesses=outcome.fitness,
        descriptors=outcome.descriptor,
        gradients=select(sound & ~outcome.faulty, gradients, zeros),
        faulty=outcome.faulty,
        overflowed=~sound & ~outcome.faulty,
    )


def require_floating(genotypes: Genotype) -> None:
    """Checks that genotypes have a gradient.

    Raises:
        TypeError: A leaf is not of floating point.
    """
    for leaf in jax.tree.leaves(genotypes):
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            given = Fact(f"an array of {jnp.result_type(leaf)}")
            raise TypeError(message("genotypes", given, "arrays of floating point"))


def finite_rows(tree: PyTree) -> jax.Array:
    """Returns whether each row is finite, (n,) for leaves (n, ...)."""
    leaves = jax.tree.leaves(tree)
    finite = [jnp.isfinite(x).reshape(x.shape[0], -1).all(axis=1) for x in leaves]
    return jnp.stack(finite).all(axis=0)
