"""Gradient-based emitters search on small problems with known gradients."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from emitter_problems import (
    MAKERS,
    SIZE,
    algorithm,
    centroids,
    compiled,
    emit,
    isoline,
    isoline_coverage,
    result,
    score,
    scored,
    searcher,
    start,
)
from jax.sharding import Mesh, PartitionSpec
from point_runs import PointEnv
from qdax.core.containers.mapelites_repertoire import MapElitesRepertoire
from qdax.core.emitters.emitter import Emitter
from qdax.core.emitters.multi_emitter import MultiEmitter
from qdax.core.map_elites import MAPElites
from test_actor_critic import SIZE as WEIGHTS
from test_actor_critic import emitter as actors
from test_actor_critic import method
from test_ascent import climbing
from test_conditioned import emitter as conditioned
from test_conditioned import policy as conditioned_policy

from newton_qd.qd.emitters import (
    CMAMAEGAEmitter,
    CMAMEGAEmitter,
    EpisodeLearning,
    OMGMEGAEmitter,
    WindowArborescenceEmitter,
)
from newton_qd.qd.emitters.annealed_repertoire import AnnealedRepertoire

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=() if n in ("line", "cma_mega") else pytest.mark.slow)
        for n in MAKERS
    ],
)
def test_beats_random_variation(name: str) -> None:
    _, state, first, rows = result(name)
    assert float(rows["qd_score"][-1]) > 3 * float(first["qd_score"])
    assert float(rows["coverage"][-1]) > 1.5 * isoline_coverage()
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(rows))
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
    assert not any(np.any(np.isnan(x)) for x in floats)
    assert np.all(np.isfinite(repertoire.genotypes))
    assert np.abs(repertoire.genotypes).max() <= 0.8
    assert float(rows["coverage"][-1]) > 0.1
    # The line emitter has no state; the loop counts its individuals.
    assert rejected(state) > 0 or name == "line"


def searches(name: str) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """A short search, and the same one inside of ``shard_map``."""
    search = algorithm(MAKERS[name](score), annealed=name == "cma_maega")

    def run(initial: jax.Array, key: jax.Array) -> tuple:
        carry = (*search.init(initial, centroids(), key)[:2], key)
        (repertoire, state, _), _ = jax.lax.scan(
            search.scan_update, carry, None, length=2
        )
        return repertoire.genotypes, state.coefficients

    mesh, split = Mesh(jax.devices()[:1], ("x",)), PartitionSpec("x")
    # the key is the same on all devices
    each = jax.shard_map(
        run, mesh=mesh, in_specs=(split, PartitionSpec()), out_specs=split
    )
    return run, each


@pytest.mark.parametrize("name", ["cma_mega", "cma_maega"])
def test_a_search_fits_on_each_device(name: str) -> None:
    """A loop in ``shard_map`` needs the same types before and after a generation."""
    found = jax.eval_shape(searches(name)[1], start(), jax.random.key(1))
    assert found[0].shape == (len(centroids()), SIZE)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cma_mega", "cma_maega"])
def test_a_search_runs_on_each_device(name: str) -> None:
    for own, other in zip(
        *(compiled(run)(start(), jax.random.key(1)) for run in searches(name)),
        strict=True,
    ):
        np.testing.assert_array_equal(own, other)


def sums(genotypes: Any, key: jax.Array) -> tuple[Any, Any, dict[str, Any]]:
    del key
    return genotypes.sum(axis=1), genotypes[:, :2], {}


def lossy(weights: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    del key
    return weights, weights[:, 0] > 0


def actors_of_episodes() -> Emitter:
    learning = EpisodeLearning(method(), PointEnv(), 1, 1, 0.1)
    return actors(later=learning, to_empty=0.5)


def window_arborescence() -> Emitter:
    first = PointEnv().reset(jax.random.key(0))
    return WindowArborescenceEmitter(
        sums, method(), first, probes=2, walks=2, sigma_g=0.5, batch_size=4
    )


LEARNERS: dict[str, tuple[Callable[[], Emitter], int]] = {
    "ascent": (climbing, 20),
    "lossy_ascent": (lambda: climbing(slope=lossy), 20),
    "actors": (actors, WEIGHTS),
    "actors_of_episodes": (actors_of_episodes, WEIGHTS),
    "conditioned": (conditioned, conditioned_policy().size),
    "window_arborescence": (window_arborescence, WEIGHTS),
}


@pytest.mark.parametrize("one_key", [True, pytest.param(False, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", LEARNERS)
def test_actors_learn_on_each_device(name: str, one_key: bool) -> None:
    """Types of ``shard_map`` fit, with one key for all devices or one for each."""
    make, size = LEARNERS[name]
    init: Any = MapElitesRepertoire.init
    if name == "window_arborescence":
        init = functools.partial(
            AnnealedRepertoire.init, learning_rate=0.1, threshold_min=0.0
        )
    search = MAPElites(sums, make(), lambda _: {}, repertoire_init=init)

    def run(initial: jax.Array, keys: jax.Array) -> Any:
        key = keys if one_key else keys[0]
        carry = (*search.init(initial, centroids(), key)[:2], key)
        (repertoire, _, _), _ = jax.lax.scan(search.scan_update, carry, None, length=2)
        return repertoire.genotypes

    mesh, split = Mesh(jax.devices()[:1], ("x",)), PartitionSpec("x")
    specs = (split, PartitionSpec() if one_key else split)
    each = jax.shard_map(run, mesh=mesh, in_specs=specs, out_specs=split)
    key = jax.random.key(1)
    initial = jax.ShapeDtypeStruct((16, size), jnp.float32)
    found = jax.eval_shape(each, initial, key if one_key else key[None])
    assert found.shape == (len(centroids()), size)


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


def test_gradients_belong_to_the_elites_of_all_emitters() -> None:
    repertoire, state, _, _ = result("mixed")
    gradients = state.emitter_states[0]
    filled = np.asarray(repertoire.fitnesses)[:, 0] > -np.inf
    np.testing.assert_array_equal(gradients.known(repertoire), filled)
    expected = scored(repertoire.genotypes, jax.random.key(0))[2]["gradients"]
    expected = np.swapaxes(expected, 1, 2)
    np.testing.assert_allclose(
        np.asarray(gradients.gradients)[filled], np.asarray(expected)[filled], atol=1e-6
    )


def test_stale_gradients_are_not_used() -> None:
    repertoire, state, _, _ = result("omg_mega")
    changed = repertoire.replace(fitnesses=repertoire.fitnesses + 1)
    assert not np.any(state.known(changed))
    genotypes = emit(OMGMEGAEmitter(8, 0.5), changed, state)
    # Without gradients an offspring is its parent.
    same = np.all(genotypes[:, None] == np.asarray(changed.genotypes), axis=-1)
    assert np.all(np.any(same, axis=1))
