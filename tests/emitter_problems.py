"""Small problems with known gradients, and searches on them, for tests of emitters."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from qdax.core.containers.mapelites_repertoire import (
    MapElitesRepertoire,
    compute_euclidean_centroids,
)
from qdax.core.emitters.multi_emitter import MultiEmitter
from qdax.core.emitters.mutation_operators import isoline_variation
from qdax.core.emitters.standard_emitters import MixingEmitter
from qdax.core.map_elites import MAPElites

from newton_qd.gradients import EpisodeGradients
from newton_qd.qd.emitters import (
    CMAMAEGAEmitter,
    CMAMEGAEmitter,
    GradientLineEmitter,
    GradientVariationEmitter,
    OMGMEGAEmitter,
    SteeringEmitter,
)
from newton_qd.qd.emitters.annealed_repertoire import AnnealedRepertoire

# These programs run for milliseconds: they need no optimizer.
compiled = functools.partial(
    jax.jit, compiler_options={"xla_backend_optimization_level": 0}
)

SIZE = 20

ITERATIONS = 60

START = np.zeros(SIZE, np.float32)


def values(genotype: jax.Array) -> jax.Array:
    """(3,) sphere about 0.5, and the mean of each half."""
    half = SIZE // 2
    fitness = -jnp.mean((genotype - 0.5) ** 2)
    means = jnp.mean(genotype[:half]), jnp.mean(genotype[half:])
    return jnp.stack([fitness, *means])


def score(genotypes: jax.Array, key: jax.Array) -> tuple[Any, Any, dict[str, Any]]:
    """Scores with gradients."""
    del key
    found = jax.vmap(values)(genotypes)
    gradients = jax.vmap(jax.jacrev(values))(genotypes)
    return found[:, 0], found[:, 1:], {"gradients": jnp.swapaxes(gradients, 1, 2)}


scored = compiled(score)


def broken(
    genotypes: jax.Array, key: jax.Array, limit: Any = 0.8
) -> tuple[Any, Any, dict[str, Any]]:
    """Scores that are not finite where the genotype exceeds a limit somewhere."""
    fitnesses, descriptors, extra = score(genotypes, key)
    large = jnp.max(jnp.abs(genotypes), axis=1) > limit
    gradients = jnp.where(large[:, None, None], jnp.nan, extra["gradients"])
    # What evolve's scoring function does with a faulty world.
    fitnesses = jnp.where(large, -jnp.inf, fitnesses)
    return fitnesses, descriptors, {"gradients": gradients}


@functools.cache
def centroids(dtype: Any = jnp.float32) -> jax.Array:
    with jax.ensure_compile_time_eval():
        cells = compute_euclidean_centroids((10, 10), [-1.0, -1.0], [1.0, 1.0])
        return cells.astype(dtype)


def no_mutation(genotypes: Any, key: jax.Array) -> Any:
    del key
    return genotypes


def isoline(batch_size: int) -> MixingEmitter:
    variation: Any = functools.partial(
        isoline_variation, iso_sigma=0.05, line_sigma=0.1
    )
    return MixingEmitter(no_mutation, variation, 1.0, batch_size)  # pyright: ignore[reportArgumentType]


def along(scoring: Callable) -> Callable[..., EpisodeGradients]:
    """Gradient along directions (N, R, 3) from a scoring function."""

    def gradient(genotypes: Any, directions: Any, key: Any) -> EpisodeGradients:
        fitnesses, descriptors, extra = scoring(genotypes, key)
        rows = jnp.einsum("nrk,nsk->nrs", directions, extra["gradients"])
        faulty = fitnesses == -jnp.inf
        return EpisodeGradients(fitnesses, descriptors, rows, faulty, faulty[:, None])

    return gradient


MAKERS: dict[str, Callable[[Callable], Any]] = {
    "omg_mega": lambda f: OMGMEGAEmitter(16, sigma_g=0.5),
    "cma_mega": lambda f: CMAMEGAEmitter(f, sigma_g=0.5, batch_size=8, num_emitters=2),
    "cma_maega": lambda f: CMAMAEGAEmitter(
        f, sigma_g=0.5, batch_size=16, optimizer=optax.adam(0.05), start=START
    ),
    "mixed": lambda f: MultiEmitter(
        (
            GradientVariationEmitter(
                6,
                optax.adam(0.05),
                steps=3,
                scoring_function=f,
                directions=[(1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)],
            ),
            SteeringEmitter(6, max_step=2.0, steps=2, scoring_function=f),
            isoline(4),
        )
    ),
    "line": lambda f: MultiEmitter(
        (
            GradientLineEmitter(
                along(f), parents=3, branches=4, shortest=0.1, longest=3.0
            ),
            isoline(4),
        )
    ),
}


def metrics(repertoire: Any) -> dict[str, jax.Array]:
    fitnesses = getattr(repertoire, "result", repertoire).fitnesses[:, 0]
    filled = fitnesses > -jnp.inf
    # The worst of the box has a fitness of -2.25.
    return {
        "qd_score": jnp.sum(jnp.where(filled, fitnesses + 2.25, 0)),
        "coverage": jnp.mean(filled),
    }


def algorithm(emitter: Any, scoring: Callable = score, annealed: bool = False) -> Any:
    make: Any = MapElitesRepertoire.init
    if annealed:
        make = functools.partial(
            AnnealedRepertoire.init, learning_rate=0.1, threshold_min=-2.25
        )
    return MAPElites(scoring, emitter, metrics, make)


@functools.cache
def start() -> np.ndarray:
    """(16, SIZE) initial population."""
    draw = np.random.default_rng(0).normal
    return (0.1 * draw(size=(16, SIZE))).astype(np.float32)


def begin(emitter: Any, count: int = 16, scoring: Callable = score) -> tuple:
    """Repertoire and emitter state of the initial population."""
    init = compiled(algorithm(emitter, scoring).init)
    return init(start()[:count], centroids(), jax.random.key(0))[:2]


@functools.cache
def emission(emitter: Any) -> Any:
    return compiled(emitter.emit)


def emit(emitter: Any, repertoire: Any, state: Any) -> np.ndarray:
    """Offspring of an emitter."""
    return np.asarray(emission(emitter)(repertoire, state, jax.random.key(1))[0])


@functools.cache
def searcher(name: str) -> Callable[..., Any]:
    """Compiled search: maps a seed and ``broken``'s limit to what it found."""

    def run(seed: jax.Array, limit: jax.Array) -> tuple:
        scoring = functools.partial(broken, limit=limit)
        search = algorithm(MAKERS[name](scoring), scoring, name == "cma_maega")
        init_key, key = jax.random.split(jax.random.key(seed))
        initial = 0.1 * jax.random.normal(init_key, (16, SIZE), jnp.float32)
        repertoire, state, first = search.init(initial, centroids(), init_key)
        carry, rows = jax.lax.scan(
            search.scan_update, (repertoire, state, key), None, length=ITERATIONS
        )
        return carry[0], carry[1], first, rows

    return compiled(run)


@functools.cache
def result(name: str, limit: float = np.inf) -> Any:
    return searcher(name)(0, limit)


@functools.cache
def isoline_coverage() -> float:
    """What QDax's variation alone fills with the same number of individuals."""
    search = algorithm(isoline(16))

    def run(initial: jax.Array) -> jax.Array:
        begun = search.init(initial, centroids(), jax.random.key(0))[:2]
        carry = (*begun, jax.random.key(1))
        _, rows = jax.lax.scan(search.scan_update, carry, length=ITERATIONS)
        return rows["coverage"][-1]

    return float(compiled(run)(start()))
