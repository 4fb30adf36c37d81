"""Gradient-based emitters on small problems with known gradients."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from qdax.core.containers.mapelites_repertoire import (
    MapElitesRepertoire,
    compute_euclidean_centroids,
    get_cells_indices,
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
    GradientsError,
    GradientVariationEmitter,
    OMGMEGAEmitter,
    RestartRule,
    SteeringEmitter,
)
from newton_qd.qd.emitters.annealed_repertoire import AnnealedRepertoire
from newton_qd.qd.scoring.gradient_scores import normalize, read_scores

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


def centroids(dtype: Any = jnp.float32) -> jax.Array:
    return compute_euclidean_centroids((10, 10), [-1.0, -1.0], [1.0, 1.0]).astype(dtype)


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
def start() -> jax.Array:
    """(16, SIZE) initial population."""
    return 0.1 * jax.random.normal(jax.random.key(0), (16, SIZE), jnp.float32)


def begin(emitter: Any, count: int = 16, scoring: Callable = score) -> tuple:
    """Repertoire and emitter state of the initial population."""
    init = compiled(algorithm(emitter, scoring).init)
    return init(start()[:count], centroids(), jax.random.key(0))[:2]


def emit(emitter: Any, repertoire: Any, state: Any) -> jax.Array:
    return compiled(emitter.emit)(repertoire, state, jax.random.key(1))[0]


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
    repertoire, state, _ = search.init(start(), centroids(), jax.random.key(0))
    carry = (repertoire, state, jax.random.key(1))
    scan = functools.partial(jax.lax.scan, search.scan_update, length=ITERATIONS)
    _, rows = compiled(scan)(carry, None)
    return float(rows["coverage"][-1])


@pytest.mark.parametrize("name", MAKERS)
def test_beats_random_variation(name: str) -> None:
    _, state, first, rows = result(name)
    assert float(rows["qd_score"][-1]) > 3 * float(first["qd_score"])
    assert float(rows["coverage"][-1]) > 1.5 * isoline_coverage()
    assert all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(rows))
    assert rejected(state) == 0


def rejected(state: Any) -> int:
    inner = getattr(state, "emitter_states", (state,))
    return sum(int(s.rejected) for s in inner if hasattr(s, "rejected"))


@pytest.mark.parametrize("name", MAKERS)
def test_seed_decides_every_bit(name: str) -> None:
    def bits(tree: Any) -> list[bytes]:
        leaves = jax.tree.leaves(tree)
        is_key = [jnp.issubdtype(x.dtype, jax.dtypes.prng_key) for x in leaves]
        plain = [
            jax.random.key_data(x) if k else x
            for x, k in zip(leaves, is_key, strict=True)
        ]
        return [np.asarray(x).tobytes() for x in plain]

    again = searcher(name)(0, np.inf)
    assert bits(again) == bits(result(name))
    other = searcher(name)(1, np.inf)
    assert bits(other[0].genotypes) != bits(again[0].genotypes)


@pytest.mark.parametrize("name", MAKERS)
def test_contains_what_is_not_finite(name: str) -> None:
    repertoire, state, _, rows = result(name, 0.8)
    floats = [
        x for x in jax.tree.leaves(state) if jnp.issubdtype(x.dtype, jnp.floating)
    ]
    assert not any(bool(jnp.any(jnp.isnan(x))) for x in floats)
    assert bool(jnp.all(jnp.isfinite(repertoire.genotypes)))
    assert float(jnp.max(jnp.abs(repertoire.genotypes))) <= 0.8
    assert float(rows["coverage"][-1]) > 0.1
    # The line emitter has no state; the loop counts its individuals.
    assert rejected(state) > 0 or name == "line"


@pytest.mark.parametrize("name", MAKERS)
def test_state_is_a_pytree_of_fixed_types(name: str, x64: None) -> None:
    # Under x64, where everything that does not say its dtype changes it.
    emitter = MAKERS[name](score)
    # QDax's own variation turns to float64 there.
    emitter = getattr(emitter, "emitters", (emitter,))[0]
    search = algorithm(emitter, annealed=name == "cma_maega")
    initial = jnp.zeros((16, SIZE), jnp.float32)
    key = jax.random.key(0)
    repertoire, state, _ = jax.eval_shape(search.init, initial, centroids(), key)
    genotypes, _ = jax.eval_shape(search.ask, repertoire, state, key)
    assert genotypes.shape == (emitter.batch_size, SIZE)
    assert genotypes.dtype == jnp.float32
    carry = (repertoire, state, key)
    after = jax.eval_shape(lambda c: search.scan_update(c, None)[0], carry)
    types = functools.partial(jax.tree.map, lambda x: (x.shape, x.dtype))
    assert types(after) == types(carry)


def test_all_mix_in_one_loop() -> None:
    emitter = MultiEmitter(
        (
            CMAMEGAEmitter(score, sigma_g=0.5, batch_size=5, num_emitters=2),
            CMAMAEGAEmitter(score, sigma_g=0.5, batch_size=4),
            OMGMEGAEmitter(3, sigma_g=0.5),
            isoline(2),
        )
    )
    search = algorithm(emitter, annealed=True)

    def run(initial: jax.Array, key: jax.Array) -> Any:
        repertoire, state, _ = search.init(initial, centroids(), key)
        return search.scan_update((repertoire, state, key), None)[0]

    repertoire, state, _ = jax.eval_shape(run, start(), jax.random.key(0))
    assert emitter.batch_size == 10 + 4 + 3 + 2
    assert state.emitter_states[0].points.shape == (2, SIZE)
    assert isinstance(repertoire, AnnealedRepertoire)


def test_omg_mega_steps_along_the_gradients() -> None:
    emitter = OMGMEGAEmitter(64, sigma_g=0.3)
    repertoire, state = begin(emitter, 1)
    steps = np.asarray(emit(emitter, repertoire, state) - start()[:1])
    gradients = normalize(score(start()[:1], jax.random.key(0))[2]["gradients"][0].T)
    coefficients, residual, _, _ = np.linalg.lstsq(gradients.T, steps.T, rcond=None)
    assert np.max(residual) < 1e-9
    assert np.all(coefficients[0] > 0)
    assert 0.2 < np.std(coefficients[1:]) < 0.4


def test_gradients_belong_to_the_elites_of_all_emitters() -> None:
    repertoire, state, _, _ = result("mixed")
    gradients = state.emitter_states[0]
    filled = np.asarray(repertoire.fitnesses[:, 0] > -np.inf)
    np.testing.assert_array_equal(gradients.known(repertoire), filled)
    expected = score(repertoire.genotypes, jax.random.key(0))[2]["gradients"]
    expected = np.swapaxes(expected, 1, 2)
    np.testing.assert_allclose(
        np.asarray(gradients.gradients)[filled], np.asarray(expected)[filled], atol=1e-6
    )


def test_stale_gradients_are_not_used() -> None:
    repertoire, state, _, _ = result("omg_mega")
    changed = repertoire.replace(fitnesses=repertoire.fitnesses + 1)
    assert not jnp.any(state.known(changed))
    genotypes = emit(OMGMEGAEmitter(8, 0.5), changed, state)
    # Without gradients an offspring is its parent.
    same = jnp.all(genotypes[:, None] == changed.genotypes, axis=-1)
    assert jnp.all(jnp.any(same, axis=1))


def test_variation_climbs_as_gradient_ascent_does() -> None:
    emitter = GradientVariationEmitter(
        4, optax.sgd(0.1), steps=3, scoring_function=score
    )
    genotypes = emit(emitter, *begin(emitter, 1))
    expected = np.asarray(start()[0], np.float64)
    for _ in range(3):
        gradient = 0.5 - expected
        expected += 0.1 * gradient / np.linalg.norm(gradient)
    np.testing.assert_allclose(genotypes, np.tile(expected, (4, 1)), atol=1e-5)


def test_steering_lands_in_empty_cells() -> None:
    # Descriptors are linear here: one step reaches the target.
    emitter = SteeringEmitter(32, max_step=100.0)
    repertoire, state = begin(emitter)
    genotypes = emit(emitter, repertoire, state)
    descriptors = score(genotypes, jax.random.key(0))[1]
    cells = get_cells_indices(descriptors, centroids())
    assert jnp.all(repertoire.fitnesses[cells, 0] == -jnp.inf)
    short = emit(SteeringEmitter(32, max_step=0.1), repertoire, state)
    steps = np.asarray(short)[:, None] - np.asarray(repertoire.genotypes)
    lengths = np.linalg.norm(steps, axis=-1).min(axis=1)
    assert np.all(lengths <= 0.1 * (1 + 1e-5))


def test_lines_climb_and_steer() -> None:
    emitter = GradientLineEmitter(
        along(score), parents=4, branches=3, shortest=0.1, longest=0.8
    )
    repertoire, state = begin(emitter, count=1)
    parent = np.asarray(start()[0])
    steps = np.asarray(emit(emitter, repertoire, state)).reshape(4, 3, SIZE) - parent
    lengths = np.linalg.norm(steps, axis=2)
    edges = 0.1 * 8 ** (np.arange(4) / 3)
    assert np.all((lengths >= edges[:-1] - 1e-5) & (lengths <= edges[1:] + 1e-5))
    ways = steps / lengths[..., None]
    gradients = np.asarray(score(start()[:1], jax.random.key(0))[2]["gradients"][0])
    uphill = gradients[:, 0] / np.linalg.norm(gradients[:, 0])
    np.testing.assert_allclose(ways[:2], np.broadcast_to(uphill, (2, 3, SIZE)), 1e-4)
    # The others change the descriptors alone, which are means of halves.
    for way in ways[2:]:
        np.testing.assert_allclose(way, np.broadcast_to(way[0], way.shape), atol=1e-5)
        halves = way[0].reshape(2, -1)
        np.testing.assert_allclose(halves, halves[:, :1] * np.ones(10), atol=1e-5)


def unbeatable(genotypes: jax.Array, key: jax.Array) -> tuple:
    """One cell, whose elite nobody beats."""
    _, descriptors, extra = score(genotypes, key)
    penalty = jnp.linalg.norm(genotypes - start()[0], axis=1)
    return -penalty, 0 * descriptors, extra


@pytest.mark.parametrize(
    ("rule", "period", "expected"),
    [
        (RestartRule.BASIC, 3, [1, 2, 0, 1, 2, 0]),
        (RestartRule.NO_IMPROVEMENT, None, [0, 0, 0, 0, 0, 0]),
        ("no_improvement", None, [0, 0, 0, 0, 0, 0]),
    ],
)
def test_points_restart_from_elites(
    rule: Any, period: int | None, expected: list[int]
) -> None:
    emitter = CMAMEGAEmitter(
        unbeatable, sigma_g=0.5, batch_size=8, restart_rule=rule, restart_period=period
    )
    search = algorithm(emitter, unbeatable)

    def run(initial: jax.Array) -> Any:
        key = jax.random.key(0)
        carry = (*search.init(initial, centroids(), key)[:2], key)

        def step(carry: Any, _: None) -> tuple:
            carry, _ = search.scan_update(carry, None)
            repertoire, state, _ = carry
            elite = jnp.any(jnp.all(state.points[0] == repertoire.genotypes, axis=-1))
            return carry, (state.age[0], elite, state.cma_es.mean[0])

        return jax.lax.scan(step, carry, None, length=6)[1]

    ages, elite, mean = compiled(run)(start())
    assert ages.tolist() == expected
    restarted = np.asarray(ages) == 0
    assert np.all(np.asarray(elite)[restarted])
    np.testing.assert_array_equal(np.all(np.asarray(mean) == 0, axis=1), restarted)


def test_emitting_and_updating_agree() -> None:
    # What QDax 0.5.0 gets wrong: the point must move by what was emitted.
    emitter = CMAMEGAEmitter(score, sigma_g=0.5, batch_size=9)
    search = algorithm(emitter)
    repertoire, state = begin(emitter)
    genotypes = emit(emitter, repertoire, state)
    fitnesses, descriptors, _ = score(genotypes, jax.random.key(2))
    _, after, _ = compiled(search.tell)(
        genotypes, fitnesses, descriptors, repertoire, state
    )
    cells = get_cells_indices(descriptors, centroids())[1:]
    bars = np.asarray(state.bars)[cells]
    new = bars == -np.inf
    worth = np.asarray(fitnesses)[1:] - np.where(new, 0, bars)
    order = np.lexsort((-worth, -np.where(new, 2, worth > 0)))
    weights = np.log(4.5) - np.log(np.arange(1, 5))
    parents = np.asarray(genotypes)[1:][order[:4]]
    expected = (weights / weights.sum()) @ parents
    assert int(after.restarts) == 0
    np.testing.assert_allclose(after.points[0], expected, atol=1e-5)


def _without_gradients(genotypes: jax.Array, key: jax.Array) -> tuple:
    fitnesses, descriptors, _ = score(genotypes, key)
    return fitnesses, descriptors, {"grads": fitnesses}


@pytest.mark.parametrize("name", ["omg_mega", "cma_mega", "cma_maega", "mixed"])
def test_missing_gradients_are_named(name: str) -> None:
    scoring = _without_gradients
    search = algorithm(MAKERS[name](scoring), scoring, name == "cma_maega")
    with pytest.raises(GradientsError, match=r"'gradients'\] is missing.*'grads'"):
        jax.eval_shape(search.init, start(), centroids(), jax.random.key(0))


def test_errors_name_what_is_wrong() -> None:
    fitnesses, descriptors, extra = score(start(), jax.random.key(0))
    read = functools.partial(read_scores, start(), fitnesses, descriptors)
    with pytest.raises(GradientsError, match="extra_scores holds nothing"):
        read(None)
    swapped = {"gradients": jnp.swapaxes(extra["gradients"], 1, 2)}
    with pytest.raises(GradientsError, match=r"\(16, 20, 3\).*swap the last two axes"):
        read(swapped)
    with pytest.raises(GradientsError, match=r"got \(16, 19, 3\)"):
        read({"gradients": extra["gradients"][:, 1:]})
    with pytest.raises(GradientsError, match="ravel_pytree"):
        read_scores({"w": start()}, fitnesses, descriptors, extra)

    with pytest.raises(GradientsError, match=r"start must have .*\(20,\), got \(3,\)"):
        begin(CMAMEGAEmitter(score, sigma_g=1.0, start=jnp.zeros(3)))
    with pytest.raises(TypeError, match="AnnealedRepertoire"):
        begin(CMAMAEGAEmitter(score, sigma_g=1.0))
    with pytest.raises(ValueError, match=r"1 \+ D = 3 columns, got 2"):
        emitter = GradientVariationEmitter(4, optax.sgd(1.0), directions=[(1, 0)])
        emit(emitter, *begin(emitter))
    # Values are known outside jit only.
    search = algorithm(
        CMAMEGAEmitter(broken, sigma_g=1.0, start=jnp.ones(SIZE)), broken
    )
    with pytest.raises(GradientsError, match="not finite"):
        search.init(start(), centroids(), jax.random.key(0))


def line(**changes: Any) -> GradientLineEmitter:
    given = {"parents": 2, "branches": 2, "shortest": 0.1, "longest": 1.0, **changes}
    return GradientLineEmitter(along(score), **given)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: OMGMEGAEmitter(0, 1.0), "batch_size must be at least 1, got 0"),
        (lambda: OMGMEGAEmitter(4, 0.0), "sigma_g must be positive, got 0.0"),
        (lambda: CMAMEGAEmitter(score, sigma_g=-1.0), "sigma_g must be positive"),
        (lambda: CMAMEGAEmitter(score, sigma_g=1.0, batch_size=2), "at least 3, got 2"),
        (
            lambda: CMAMEGAEmitter(score, sigma_g=1.0, restart_period=0),
            "restart_period must be at least 1, got 0",
        ),
        (
            lambda: GradientVariationEmitter(4, optax.sgd(1.0), steps=2),
            "steps = 2 needs a scoring_function",
        ),
        (
            lambda: GradientVariationEmitter(4, optax.sgd(1.0), directions=[1.0]),
            "directions must be finite numbers",
        ),
        (
            lambda: line(parents=0),
            "parents must be at least 1, got 0",
        ),
        (lambda: line(steered=2.0), r"steered must be in \[0, 1\], got 2.0"),
        (lambda: line(longest=0.0), "shortest <= longest, got shortest = 0.1, longest"),
        (lambda: SteeringEmitter(4, max_step=0.0), "max_step must be positive"),
        (lambda: SteeringEmitter(4, max_step=1.0, steps=0), "steps must be at least 1"),
    ],
)
def test_bad_settings_are_refused(make: Callable, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
