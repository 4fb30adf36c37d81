"""One generation: what enters the archive, what its emitter is told, its metrics."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from qdax.core.containers.mapelites_repertoire import MapElitesRepertoire

from newton_qd.qd.emitters.cells import break_ties
from newton_qd.qd.run import generation

# QDax and what it imports warn about their own use of other packages.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


class Unchanging:
    """An emitter whose state never changes."""

    def init(self, **told: Any) -> int:
        del told
        return 0

    def state_update(self, state: int, **told: Any) -> int:
        del told
        return state


def metrics_of(
    fitnesses: list[float], told: dict[str, Any], extra: dict[str, Any] | None = None
) -> tuple[Any, Any]:
    """Metrics of a first generation, and of one of the same individuals after it."""
    count = len(fitnesses)
    genotypes = jnp.zeros((count, 2))
    grid = jnp.linspace(0, 1, 5)[:, None]
    empty = MapElitesRepertoire.init_default(genotype=genotypes[0], centroids=grid)
    emitter: Any = Unchanging()
    made = generation.Generation(
        emitter, jax.random.key(0), takes_faulty=False, offset=0.0
    )
    found = jnp.linspace(0, 1, count)[:, None]
    scores: Any = jnp.float32(fitnesses), found, extra or {}

    @functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    def begin_and_tell() -> tuple[Any, Any]:
        repertoire, state, first = made.begin(empty, genotypes, scores)
        initial = first["initial_fitness"]
        later = made.tell(repertoire, state, genotypes, told, scores, initial)[2]
        return first, later

    return begin_and_tell()


def test_lost_gradients_of_every_part_of_an_emitter_are_rejected() -> None:
    lost = {"climbers_overflowed": jnp.array([True, False, True])}
    assert metrics_of([1.0, 2.0, 3.0], lost)[1]["rejected"] == 2


def test_lost_gradients_of_scores_are_rejected_once() -> None:
    """One of these individuals has neither a fitness nor two of its gradients."""
    rows = jnp.array([[False, True], [False, False], [True, True]])
    for metrics in metrics_of([1.0, 2.0, -np.inf], {}, {"overflowed": rows}):
        assert metrics["rejected"] == 2


def test_the_initial_fitness_is_the_median_of_what_is_finite() -> None:
    assert metrics_of([1.0, 2.0, 9.0, -np.inf], {})[0]["initial_fitness"] == 2


class Telling(Unchanging):
    """An emitter whose state is what it was told of the scores."""

    def init(self, **told: Any) -> Any:
        return told["fitnesses"], told["descriptors"]


@pytest.mark.parametrize(("takes_faulty", "fitness"), [(True, -np.inf), (False, -6.0)])
def test_an_emitter_is_told_of_faulty_individuals(
    takes_faulty: bool, fitness: float
) -> None:
    """With the worst fitness, and a descriptor that is finite."""
    emitter: Any = Telling()
    made = generation.Generation(emitter, jax.random.key(0), takes_faulty, offset=6.0)
    grid = jnp.linspace(0, 1, 5)[:, None]
    empty = MapElitesRepertoire.init_default(genotype=jnp.zeros(2), centroids=grid)
    scores: Any = (
        np.array([1, 2, np.nan, 4], np.float32),
        np.array([[0], [0.5], [1], [np.nan]], np.float32),
        {},
    )
    begin = jax.jit(made.begin)
    repertoire, told, metrics = begin(empty, np.zeros((4, 2), np.float32), scores)
    assert told[0].tolist() == [1, 2, fitness, fitness]
    assert told[1].tolist() == [[0], [0.5], [1], [0]]
    fitnesses = np.asarray(repertoire.fitnesses)[:, 0]
    assert fitnesses.tolist() == [1, -np.inf, 2, -np.inf, -np.inf]
    assert metrics["rejected"] == 2


def test_equal_individuals_of_a_cell_do_not_compete() -> None:
    descriptors = jnp.array([[0.1, 0.1], [0.9, 0.9], [0.1, 0.2], [0.2, 0.1]])
    fitnesses = jnp.array([1.0, 1.0, 1.0, 2.0])
    centroids = jnp.array([[0.2, 0.2], [0.8, 0.8]])
    kept = break_ties(fitnesses, descriptors, centroids)
    np.testing.assert_array_equal(kept, [1.0, 1.0, -np.inf, 2.0])


def test_of_equally_fit_individuals_the_first_enters() -> None:
    """QDax would take the last one here, and any of them on a GPU."""
    emitter: Any = Unchanging()
    made = generation.Generation(emitter, jax.random.key(0), False, 0.0)
    grid = jnp.linspace(0, 1, 5)[:, None]
    empty = MapElitesRepertoire.init_default(genotype=jnp.zeros(1), centroids=grid)
    scores: Any = np.array([1, 2, 2], np.float32), np.zeros((3, 1), np.float32), {}
    genotypes = np.array([[5], [6], [7]], np.float32)
    repertoire = jax.jit(made.enter)(empty, genotypes, scores)
    assert np.asarray(repertoire.genotypes)[0] == 6.0
