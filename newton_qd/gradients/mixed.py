"""The gradient of a smoothed episode: a mix of first and zeroth order."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from newton_qd import checks
from newton_qd.envs.state import select
from newton_qd.gradients.exact import EpisodeGradients, finite_rows, require_floating
from newton_qd.gradients.outcome import Outcome
from newton_qd.moved import moved_name
from newton_qd.physics.explicit_mesh import rows_split_as
from newton_qd.types import Genotype, PyTree, RNGKey

_MOVED = {
    "make_mixed_gradient": "newton_qd.gradients.make_mixed_gradient",
}


def __getattr__(name: str) -> Any:
    """Returns a moved object by its old name."""
    return moved_name(__name__, name, _MOVED)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class MixedGradients(EpisodeGradients):
    """Gradients of smoothed episodes, and the quality of the two estimates.

    Fitness, descriptor and ``faulty`` are those of the genotype without noise.
    ``overflowed`` is true if fewer than two pairs of samples had no fault, or if
    neither order was finite.

    Attributes:
        order: (N, 1 + D) alpha, the weight of the first-order estimate, 0 to 1 [-].
        first_variance: (N, 1 + D) variance of a first-order sample, summed over the
            genotype. It is infinite if a sample was not finite, or if the variance is
            too large for the dtype.
        zeroth_variance: (N, 1 + D) variance of a zeroth-order sample, in the same way.
        bias: (N, 1 + D) distance between the means of the two orders, minus the part
            that their variances explain.
    """

    order: jax.Array
    first_variance: jax.Array
    zeroth_variance: jax.Array
    bias: jax.Array


def check_mixture(samples: int, sigma: float, tolerance: float = math.inf) -> None:
    """Checks the settings of a mixed gradient.

    Raises:
        TypeError: A setting is not a number.
        ValueError: A setting is out of its range.
    """
    checks.integer("samples", samples, least=2)
    checks.number("sigma", sigma, above=0)
    checks.number("tolerance", tolerance, above=0, endless=True)


def mixed_gradients(
    centre: Outcome,
    gradient: Callable[[Genotype], EpisodeGradients],
    genotypes: Genotype,
    noise_key: RNGKey,
    *,
    samples: int,
    sigma: float,
    tolerance: float,
    noise_by_genotype: bool,
) -> MixedGradients:
    """Returns alpha-order gradients of N individuals, as :meth:`Episode.mixed`.

    Args:
        centre: Their episodes without noise, leaves (N, ...).
        gradient: Maps any number of genotypes to values and first-order gradients.
        genotypes: Leaves (N, ...).
        noise_key: Key of the noise.
        samples: Pairs of samples of a genotype.
        sigma: Standard deviation of the noise, in the units of the genotype.
        tolerance: Allowed error if the two orders disagree.
        noise_by_genotype: Whether the noise of an individual follows from its genotype,
            not from its place.

    Raises:
        TypeError: A genotype is not of floating point.
    """
    require_floating(genotypes)
    draw = _noise_by_genotype if noise_by_genotype else normal_noise
    noise = draw(noise_key, genotypes, samples, sigma)
    noise = rows_split_as(jax.tree.leaves(genotypes)[0], noise)
    found = _pairs(gradient, genotypes, noise)
    combine = functools.partial(_combined, sigma=sigma, tolerance=tolerance)
    return jax.vmap(combine)(centre, found, noise)


def _pairs(
    gradient: Callable[[Genotype], EpisodeGradients], genotypes: Genotype, noise: PyTree
) -> EpisodeGradients:
    """Returns values and gradients at x + w and x - w, leaves (N, samples, 2, ...)."""
    signs = jnp.array([1, -1], jnp.int32)

    def moved(x: jax.Array, w: jax.Array) -> jax.Array:
        sign = signs.astype(w.dtype).reshape(2, *[1] * (w.ndim - 2))
        return x[:, None, None] + w[:, :, None] * sign

    around = jax.tree.map(moved, genotypes, noise)
    shape = jax.tree.leaves(around)[0].shape[:3]
    rows = math.prod(shape)  # not -1: a leaf may have no elements
    found = gradient(jax.tree.map(lambda x: x.reshape(rows, *x.shape[3:]), around))
    return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), found)


def normal_noise(
    key: RNGKey, genotypes: Genotype, samples: int, sigma: float = 1.0
) -> PyTree:
    """Returns normal noise for every genotype, leaves (N, samples, ...)."""
    leaves, structure = jax.tree.flatten(genotypes)
    keys = jax.random.split(key, len(leaves))
    noise = [
        sigma * jax.random.normal(k, (len(x), samples, *x.shape[1:]), x.dtype)
        for k, x in zip(keys, leaves, strict=True)
    ]
    return jax.tree.unflatten(structure, noise)


def _noise_by_genotype(
    key: RNGKey, genotypes: Genotype, samples: int, sigma: float
) -> PyTree:
    """Returns normal noise that follows from a genotype, leaves (N, samples, ...)."""

    def noise_of(genotype: Genotype) -> PyTree:
        own = jax.random.fold_in(key, _digest(genotype, key))
        alone = jax.tree.map(lambda x: x[None], genotype)
        return jax.tree.map(lambda w: w[0], normal_noise(own, alone, samples, sigma))

    return jax.vmap(noise_of)(genotypes)


def _digest(genotype: Genotype, key: RNGKey) -> jax.Array:
    """Returns a number () of 32 bits that differs for other genotypes.

    It is the sum of all words, times random odd numbers. Sums of integers do not depend
    on their order.
    """
    words = []
    for leaf in map(jnp.asarray, jax.tree.leaves(genotype)):
        kind = jnp.dtype(f"uint{8 * min(leaf.dtype.itemsize, 4)}")
        words.append(jax.lax.bitcast_convert_type(leaf, kind).astype(jnp.uint32))
    row = jnp.concatenate([x.reshape(-1) for x in words])
    odd = jax.random.bits(key, row.shape, jnp.uint32) | 1
    return jnp.sum(row * odd, dtype=jnp.uint32)


def _like(factors: jax.Array, array: jax.Array) -> jax.Array:
    """Reshapes factors (n,) to multiply arrays (..., n, *axes of ``array`` but one)."""
    shape = factors.shape + (1,) * (array.ndim - 1)
    return factors.astype(array.dtype).reshape(shape)


def _combined(
    centre: Outcome,
    found: EpisodeGradients,
    noise: PyTree,
    *,
    sigma: float,
    tolerance: float,
) -> MixedGradients:
    """Returns the estimate of one individual from its pairs (samples, 2, ...)."""
    sound = ~found.faulty.any(axis=1)
    fitness = jnp.where(sound[:, None], found.fitnesses, 0)
    values = jnp.concatenate([fitness[..., None], found.descriptors], axis=-1)
    lost = (found.overflowed & sound[:, None, None]).any(axis=(0, 1))
    mixed = mixture(
        values, found.gradients, noise, sound, lost, sigma=sigma, tolerance=tolerance
    )
    few = (sound.sum() < 2) | (lost & jnp.isinf(mixed.zeroth_variance))
    gradients = jax.tree.map(
        lambda x, like: x.astype(like.dtype), mixed.gradients, found.gradients
    )
    zeros = jax.tree.map(jnp.zeros_like, gradients)
    return MixedGradients(
        fitnesses=centre.fitness,
        descriptors=centre.descriptor,
        gradients=select(~few & ~centre.faulty, gradients, zeros),
        faulty=centre.faulty,
        overflowed=few & ~centre.faulty,
        order=mixed.order,
        first_variance=mixed.first_variance,
        zeroth_variance=mixed.zeroth_variance,
        bias=mixed.bias,
    )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Mixture:
    """Alpha-order, first- and zeroth-order gradients (rows, ...), and their quality."""

    gradients: PyTree
    first: PyTree
    zeroth: PyTree
    order: jax.Array
    first_variance: jax.Array
    zeroth_variance: jax.Array
    bias: jax.Array


def mixture(
    values: jax.Array,
    gradients: PyTree,
    noise: PyTree,
    sound: jax.Array,
    lost: jax.Array,
    *,
    sigma: float,
    tolerance: float = math.inf,
) -> Mixture:
    """Weights the two estimates of the gradients of several functions.

    Args:
        values: (samples, 2, rows) the functions at x + w and at x - w.
        gradients: Leaves (samples, 2, rows, ...): their gradients there.
        noise: Leaves (samples, ...): w.
        sound: (samples,) whether a pair counts.
        lost: (rows,) whether a first order does not count. A zeroth order that is not
            finite does not count either.
        sigma: Standard deviation of the noise.
        tolerance: Allowed error if the two orders disagree.
    """
    first, zeroth, missing = _samples(values, gradients, noise, sound, lost, sigma)
    # squares of numbers above 1e19 are not finite in float32, so variances are computed
    # in units of the largest number of a row
    spread = functools.partial(_mean_and_variance, sound=sound)
    first_unit, zeroth_unit = _unit(first), _unit(zeroth)
    first_own = spread(_scaled(first, first_unit))[1]
    zeroth_own = spread(_scaled(zeroth, zeroth_unit))[1]
    unit = jnp.maximum(first_unit, zeroth_unit)
    first, zeroth = _scaled(first, unit), _scaled(zeroth, unit)
    first_mean, first_variance = spread(first)
    zeroth_mean, zeroth_variance = spread(zeroth)
    apart, apart_variance = spread(jax.tree.map(jnp.subtract, first, zeroth))
    pairs = jnp.maximum(sound.sum(), 1).astype(values.dtype)
    # the part of the distance of the means that the variance of the samples explains
    distance = _squared(apart)
    explained = jnp.where(lost, 0, apart_variance / pairs)
    error = jnp.sqrt(zeroth_variance / pairs)
    excess = jnp.maximum(tolerance / unit - error, 0)
    allowed = excess / jnp.maximum(jnp.sqrt(distance), 1e-30)
    total = zeroth_variance + first_variance
    flat = total == 0
    order = jnp.where(flat, 1, zeroth_variance / jnp.where(flat, 1, total))
    order = jnp.where(missing, 1, jnp.minimum(order, allowed))
    order = jnp.where(lost, 0, order)
    back = functools.partial(jax.tree.map, lambda x: x * _like(unit, x))
    share = functools.partial(_like, order)
    return Mixture(
        gradients=back(
            jax.tree.map(lambda a, b: b + share(a) * (a - b), first_mean, zeroth_mean)
        ),
        first=back(first_mean),
        zeroth=back(zeroth_mean),
        order=order,
        first_variance=jnp.where(lost, jnp.inf, first_own * first_unit**2),
        zeroth_variance=jnp.where(missing, jnp.inf, zeroth_own * zeroth_unit**2),
        bias=jnp.sqrt(jnp.maximum(distance - explained, 0)) * unit,
    )


def _samples(
    values: jax.Array,
    gradients: PyTree,
    noise: PyTree,
    sound: jax.Array,
    lost: jax.Array,
    sigma: float,
) -> tuple[PyTree, PyTree, jax.Array]:
    """Returns samples of first and zeroth order (n, rows, ...).

    The last result (rows,) marks zeroth orders that do not count. These samples are 0,
    and so are ``lost`` samples and samples that are not finite.
    """
    # not divided by sigma^2, which may be too small for the dtype
    slope = jnp.where(sound[:, None], values[:, 0] - values[:, 1], 0) / (2 * sigma)
    zeroth = jax.tree.map(
        lambda w: jax.vmap(jnp.multiply.outer)(slope, w / sigma), noise
    )
    # the barrier keeps XLA from adding before it halves, which may overflow
    halves = jax.lax.optimization_barrier(jax.tree.map(lambda g: 0.5 * g, gradients))
    first = jax.tree.map(lambda g: g[:, 0] + g[:, 1], halves)
    missing = ~jax.vmap(finite_rows)(zeroth).all(axis=0)

    def without(samples: PyTree, gone: jax.Array) -> PyTree:
        return jax.tree.map(lambda x: jnp.where(_rows(gone, x), 0, x), samples)

    return without(first, lost), without(zeroth, missing), missing


def _rows(factors: jax.Array, samples: jax.Array) -> jax.Array:
    """Reshapes factors (rows,) to multiply samples (n, rows, ...)."""
    return factors.reshape(-1, *[1] * (samples.ndim - 2))


def _scaled(samples: PyTree, unit: jax.Array) -> PyTree:
    """Returns samples (n, rows, ...) in units (rows,)."""
    return jax.tree.map(lambda x: x / _rows(unit, x), samples)


def _unit(samples: PyTree) -> jax.Array:
    """Returns a power of two (rows,) near the largest of samples; 1 if that is 0."""
    sizes = [
        jnp.abs(jnp.moveaxis(x, 1, 0)).reshape(x.shape[1], -1).max(axis=1, initial=0)
        for x in jax.tree.leaves(samples)
    ]
    largest = functools.reduce(jnp.maximum, sizes)
    # exact: division by it changes no digit. XLA multiplies by the reciprocal, which is
    # too small for the dtype if the power is larger.
    exponent = jnp.minimum(
        jnp.frexp(largest)[1] - 1, jnp.finfo(largest.dtype).maxexp - 3
    )
    one = jnp.ones_like(largest)
    return jnp.where(largest > 0, jnp.ldexp(one, exponent), one)


def _mean_and_variance(samples: PyTree, sound: jax.Array) -> tuple[PyTree, jax.Array]:
    """Returns mean (rows, ...) and total variance (rows,) of the sound samples."""
    count = sound.sum()

    def mean(x: jax.Array) -> jax.Array:
        kept = jnp.where(_like(sound, x) != 0, x, 0)
        return kept.sum(axis=0) / jnp.maximum(count, 1).astype(x.dtype)

    means = jax.tree.map(mean, samples)
    scatter = jax.tree.map(lambda x, m: mean(jnp.square(x - m)), samples, means)
    parts = [x.reshape(x.shape[0], -1).sum(axis=1) for x in jax.tree.leaves(scatter)]
    total = functools.reduce(jnp.add, parts)
    own = count.astype(total.dtype)
    return means, total * own / jnp.maximum(own - 1, 1)


def _squared(rows: PyTree) -> jax.Array:
    """Returns the squared norm (rows,) of leaves (rows, ...)."""
    squares = [jnp.square(x).reshape(x.shape[0], -1) for x in jax.tree.leaves(rows)]
    return functools.reduce(jnp.add, [x.sum(axis=1) for x in squares])
