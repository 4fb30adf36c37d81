"""Scores with gradients for emitters, checked in one place.

A scoring function maps genotypes (N, size) and a key to fitnesses (N,), descriptors
(N, D) and ``extra_scores``, with

    extra_scores["gradients"]: (N, size, 1 + D)

the gradients with respect to the genotype, in the layout of QDax's emitters. Column 0
is the gradient of the fitness, column 1 + j that of descriptor j. They are not
normalized; emitters normalize them if their paper does. An individual without a valid
evaluation has fitness ``-inf``. ``Episode.scoring`` makes such functions.
"""

from __future__ import annotations

from collections.abc import Mapping

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.checks import Fact, listed, message
from newton_qd.types import Genotype, PyTree

GRADIENTS = "gradients"
"""Key of the gradients in ``extra_scores``."""

# pyribs' epsilon: a normalized gradient is shorter than 1 if the gradient is this
# small.
_EPSILON = 1e-8
_SMALLER = 1e-20


class GradientsError(ValueError):
    """Scores do not have the gradients that an emitter needs."""


class Scores(flax.struct.PyTreeNode):
    """Evaluated individuals.

    Attributes:
        genotypes: (N, size) policy weights or other solutions.
        fitnesses: (N,) fitnesses, ``-inf`` if a score or gradient is not finite.
        descriptors: (N, D) descriptors.
        gradients: (N, 1 + D, size) gradients, zero if a score or gradient is not
            finite.
        finite: (N,) whether fitness, descriptor and gradients are finite.
    """

    genotypes: jax.Array
    fitnesses: jax.Array
    descriptors: jax.Array
    gradients: jax.Array
    finite: jax.Array


def read_scores(
    genotypes: Genotype,
    fitnesses: jax.Array,
    descriptors: jax.Array,
    extra_scores: Mapping[str, PyTree] | None,
) -> Scores:
    """Checks the result of a scoring function and marks what is not finite.

    Args:
        genotypes: (N, size) the individuals.
        fitnesses: (N,) or (N, 1) their fitnesses.
        descriptors: (N, D) their descriptors.
        extra_scores: Dictionary with ``"gradients"`` (N, size, 1 + D), and perhaps
            ``"overflowed"`` (N, 1 + D), which marks gradients that were set to 0.

    Raises:
        GradientsError: The gradients are missing or have the wrong shape, or genotypes
            are not one array.
    """
    count, size = genotype_matrix(genotypes).shape
    expected = (count, size, 1 + descriptors.shape[-1])
    allowed = f"(N, size, 1 + D) = {expected}"
    if extra_scores is None or GRADIENTS not in extra_scores:
        held = listed([repr(key) for key in extra_scores or ()], "nothing")
        given = Fact(f"{held}, and {GRADIENTS!r} is missing")
        allowed = f"with the gradients of fitness and descriptors, {allowed}"
        raise GradientsError(message("extra_scores", given, allowed))
    gradients = extra_scores[GRADIENTS]
    if jnp.shape(gradients) != expected:
        swapped = jnp.shape(gradients) == (expected[0], expected[2], expected[1])
        hint = " (swap the last two axes)" if swapped else ""
        given = Fact(f"shape {jnp.shape(gradients)}")
        name = f"extra_scores[{GRADIENTS!r}]"
        raise GradientsError(message(name, given, f"{allowed}, objective first{hint}"))
    gradients = jnp.swapaxes(jnp.asarray(gradients, genotypes.dtype), 1, 2)
    finite = finite_scores(fitnesses, descriptors) & jnp.all(
        jnp.isfinite(gradients), axis=(1, 2)
    )
    lost = extra_scores.get("overflowed")
    # an emitter beside may have put its own count there
    if lost is not None and jnp.shape(lost) == (count, expected[2]):
        finite = finite & ~jnp.any(lost, axis=1)
    return Scores(
        genotypes=genotypes,
        fitnesses=jnp.where(finite, jnp.reshape(fitnesses, (-1,)), -jnp.inf),
        descriptors=descriptors,
        gradients=jnp.where(finite[:, None, None], gradients, 0),
        finite=finite,
    )


def genotype_matrix(genotypes: Genotype) -> jax.Array:
    """Returns genotypes as one array (N, size).

    Raises:
        GradientsError: They are not one array.
    """
    if isinstance(genotypes, np.ndarray):
        genotypes = jnp.asarray(genotypes)
    if not isinstance(genotypes, jax.Array) or genotypes.ndim != 2:
        shapes = jax.tree.map(jnp.shape, genotypes)
        allowed = (
            "one array (N, size); flatten the parameters of a policy with "
            "jax.flatten_util.ravel_pytree"
        )
        raise GradientsError(message("genotypes", shapes, allowed))
    return genotypes


def finite_scores(fitnesses: jax.Array, descriptors: jax.Array) -> jax.Array:
    """Returns whether fitness and descriptor of an individual are finite (N,)."""
    finite = jnp.isfinite(jnp.reshape(fitnesses, (-1,)))
    return finite & jnp.all(jnp.isfinite(descriptors), axis=-1)


def normalize(gradients: jax.Array) -> jax.Array:
    """Returns gradients (..., size) of length 1; a zero gradient stays zero."""
    lengths = jnp.linalg.norm(gradients, axis=-1, keepdims=True)
    # squares of large numbers overflow
    gradients = gradients * jnp.where(jnp.isinf(lengths), _SMALLER, 1)
    lengths = jnp.linalg.norm(gradients, axis=-1, keepdims=True)
    return gradients / (lengths + _EPSILON)
