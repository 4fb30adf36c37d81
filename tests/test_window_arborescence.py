"""CMA-MAEGA with actors that find its gradients, on a point that is pushed about."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import itertools
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_runs import PointEnv
from qdax.core.containers.mapelites_repertoire import compute_euclidean_centroids
from test_actor_critic import SIZE, compiled, method, play

from newton_qd.qd.emitters import WindowArborescenceEmitter
from newton_qd.qd.emitters.annealed_repertoire import AnnealedRepertoire
from newton_qd.qd.emitters.whitening import Whitening
from newton_qd.qd.emitters.window_arborescence import Climbers

POINTS, EACH, PERIOD = 2, 8, 4


def score(genotypes: jax.Array, key: jax.Array) -> tuple[Any, Any, dict[str, Any]]:
    del key
    # a program inside of another one has no options of its own
    fitnesses, found = jax.vmap(inspect.unwrap(play))(genotypes)
    return fitnesses, found, {}


def emitter(**changes: Any) -> WindowArborescenceEmitter:
    given: dict[str, Any] = {"probes": 3, "walks": 3, "sigma_g": 0.5}
    first = PointEnv().reset(jax.random.key(0))
    return WindowArborescenceEmitter(
        score,
        method(),
        first,
        batch_size=EACH,
        num_emitters=POINTS,
        **{**given, **changes},
    )


@functools.cache
def generations(number: int) -> list[tuple[Any, Any]]:
    """State and individuals of each generation."""
    made = emitter(restart_period=PERIOD)
    init, emit, update = map(compiled, (made.init, made.emit, made.state_update))
    cells = compute_euclidean_centroids((4, 4), [-2.0, -2.0], [2.0, 2.0])
    genotypes = 0.1 * jax.random.normal(jax.random.key(0), (16, SIZE), jnp.float32)
    fitnesses, found, _ = compiled(score)(genotypes, jax.random.key(0))
    begin = functools.partial(
        AnnealedRepertoire.init, learning_rate=0.1, threshold_min=0.0
    )
    repertoire = compiled(begin)(genotypes, fitnesses, found, cells)
    scored, add = compiled(score), compiled(AnnealedRepertoire.add)
    state = init(jax.random.key(1), repertoire, genotypes, fitnesses, found, {})
    rows = []
    for generation in range(number):
        offspring, _ = emit(repertoire, state, jax.random.key(generation))
        rows.append((state, offspring))
        fitnesses, found, _ = scored(offspring, jax.random.key(0))
        repertoire = add(repertoire, offspring, found, fitnesses)
        state = update(state, repertoire, offspring, fitnesses, found, {})
    return rows


@pytest.mark.slow
def test_gradients_raise_what_they_are_of() -> None:
    """Return, and both coordinates of the end, of a small step along each gradient."""
    state = generations(6)[0][0]
    assert state.gradients.shape == (POINTS, 3, SIZE)
    lengths = np.linalg.norm(state.gradients, axis=2)
    np.testing.assert_allclose(lengths, 1, rtol=1e-5)
    for point, gradients in zip(state.points, state.gradients, strict=True):
        before = np.append(*play(point))
        for index, gradient in enumerate(gradients):
            after = np.append(*play(point + 0.1 * gradient))
            assert after[index] > before[index] + 0.02


@pytest.mark.slow
def test_offspring_lie_along_the_gradients() -> None:
    for state, offspring in generations(6):
        rows = offspring.reshape(POINTS, EACH, SIZE)
        np.testing.assert_array_equal(rows[:, 0], state.points)
        steps = state.coefficients @ state.gradients
        np.testing.assert_allclose(rows[:, 1:], state.points[:, None] + steps)


@pytest.mark.slow
def test_actors_walk_where_the_best_offspring_lie() -> None:
    states = [state for state, _ in generations(6)]
    for before, after in itertools.pairwise(states):
        if not after.age.any():  # it has begun again
            continue
        mean = after.cma_es.mean
        aim = mean / np.linalg.norm(mean, axis=1, keepdims=True)
        walkers = after.optimizer.walkers
        np.testing.assert_allclose(walkers.aim, aim, rtol=1e-4)
        np.testing.assert_array_equal(walkers.weights, after.points)
        assert np.abs(after.points - before.points).max() > 0.05
        # probes begin at the point again, and keep their critics
        away = np.abs(after.optimizer.probes.weights - after.points[:, None])
        assert 0 < away.max() < 3 * 0.05 * 1.5


@jax.tree_util.register_dataclass
@dataclasses.dataclass
class Probes:
    """Actors of which the weights alone count."""

    weights: jax.Array


def test_gradients_have_length_one_for_whitened_observations() -> None:
    made: Any = emitter()
    white = Whitening(np.arange(6).reshape(3, 2), np.array([6, 7]))
    made._method = types.SimpleNamespace(
        whitening=white, moved=lambda probe, weights: Probes(weights)
    )
    ways = jax.random.normal(jax.random.key(0), (POINTS * 3, 8))
    made._updated = lambda probes, *_: Probes(probes.weights + ways)
    made._scoring_function = lambda points, key: (points[:, 0], points[:, :2], {})
    scale = jnp.array([[1.0, -2.0, 3.0]] * 2), jnp.array([[0.5, 2.0, 4.0]] * 2)
    points, probes = jnp.zeros((POINTS, 8)), Probes(jnp.zeros((POINTS, 3, 8)))
    climbers = Climbers(probes, None, scale)  # pyright: ignore[reportArgumentType]

    def gradients(points: jax.Array) -> jax.Array:
        found = made._scored(points, climbers, jax.random.key(0))[0].gradients
        return jax.vmap(white.whitened)(found, scale)

    found = compiled(gradients)(points)
    expected = ways / jnp.linalg.norm(ways, axis=1, keepdims=True)
    np.testing.assert_allclose(found.reshape(-1, 8), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_points_begin_again_from_elites() -> None:
    rows = [state for state, _ in generations(6)]
    begun = [state for state in rows[1:] if not state.age.any()]
    assert len(begun) == 1 and begun[0].restarts == POINTS
    walkers = begun[0].optimizer.walkers
    np.testing.assert_array_equal(walkers.weights, begun[0].points)
    np.testing.assert_array_equal(walkers.aim, np.tile([1.0, 0, 0], (POINTS, 1)))
    np.testing.assert_array_equal(walkers.moments[0][1][0].count, np.zeros(POINTS))


@pytest.mark.parametrize("name", ["probes", "walks"])
def test_bad_numbers_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name}: got 0; allowed: .* from 1"):
        emitter(**{name: 0})
