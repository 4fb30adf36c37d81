"""The steps of gradient-based emitters, where gradients are known."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from emitter_problems import (
    SIZE,
    algorithm,
    along,
    begin,
    centroids,
    compiled,
    emit,
    score,
    scored,
    start,
)
from qdax.core.containers.mapelites_repertoire import (
    MapElitesRepertoire,
    get_cells_indices,
)

from newton_qd.gradients import EpisodeGradients
from newton_qd.qd.emitters import (
    CMAMAEGAEmitter,
    CMAMEGAEmitter,
    GradientLineEmitter,
    GradientVariationEmitter,
    OMGMEGAEmitter,
    RestartRule,
    SteeringEmitter,
)
from newton_qd.qd.emitters.gradient_line import _units
from newton_qd.qd.emitters.ranking import IMPROVED, NEW, WORSE, best_of

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


def gradients_at_start() -> np.ndarray:
    """(3, SIZE) gradients of the first genotype."""
    return np.asarray(scored(start()[:1], jax.random.key(0))[2]["gradients"])[0].T


def test_omg_mega_steps_along_the_gradients() -> None:
    emitter = OMGMEGAEmitter(64, sigma_g=0.3)
    repertoire, state = begin(emitter, 1)
    steps = emit(emitter, repertoire, state) - start()[:1]
    gradients = gradients_at_start()
    gradients = gradients / np.linalg.norm(gradients, axis=1, keepdims=True)
    coefficients, residual, _, _ = np.linalg.lstsq(gradients.T, steps.T, rcond=None)
    assert np.max(residual) < 1e-9
    assert np.all(coefficients[0] > 0)
    assert 0.2 < np.std(coefficients[1:]) < 0.4


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


def test_each_parent_draws_a_direction() -> None:
    emitter = GradientVariationEmitter(
        32, optax.sgd(0.1), directions=[(1, 0, 0), (0, 0, -1)]
    )
    steps = (emit(emitter, *begin(emitter, 1)) - start()[:1]) / 0.1
    rows = gradients_at_start()
    rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    near = [np.abs(steps - way).max(axis=1) < 1e-4 for way in (rows[0], -rows[2])]
    assert np.all(near[0] ^ near[1]) and 4 < near[0].sum() < 28


def test_steering_lands_in_empty_cells() -> None:
    # Descriptors are linear here: one step reaches the target.
    emitter = SteeringEmitter(32, max_step=100.0)
    repertoire, state = begin(emitter)
    genotypes = emit(emitter, repertoire, state)
    descriptors = scored(genotypes, jax.random.key(0))[1]
    cells = compiled(get_cells_indices)(descriptors, centroids())
    repertoire = jax.device_get(repertoire)
    assert np.all(repertoire.fitnesses[cells, 0] == -jnp.inf)
    short = emit(SteeringEmitter(32, max_step=0.1), repertoire, state)
    steps = np.asarray(short)[:, None] - np.asarray(repertoire.genotypes)
    lengths = np.linalg.norm(steps, axis=-1).min(axis=1)
    assert np.all(lengths <= 0.1 * (1 + 1e-5))


@pytest.mark.parametrize("large", [1.0, 1e14, 1e20, 1e38])
def test_large_jacobians_give_short_steps(large: float) -> None:
    """Squares of the largest ones are not finite in float32."""
    draw = np.random.default_rng(0).normal
    jacobian = (draw(size=(3, 2, SIZE)).clip(-3, 3) * large).astype(np.float32)
    jacobian[1, 1] *= 1e-3
    jacobian[2] = 0
    error = draw(size=(3, 2)).astype(np.float32)
    step = compiled(SteeringEmitter(1, max_step=9.0)._step)(jacobian, error)
    exact = jacobian[:2].astype(np.float64)
    gram = exact @ exact.swapaxes(1, 2)
    damping = 1e-3 * np.trace(gram, axis1=1, axis2=2) / 2
    gram += damping[:, None, None] * np.eye(2)
    weights = np.linalg.solve(gram, error[:2, :, None])
    expected = (exact.swapaxes(1, 2) @ weights)[..., 0]
    # float32 has no digits below 1e-37
    np.testing.assert_allclose(step[:2], expected, rtol=1e-3, atol=1e-4 / large + 1e-37)
    np.testing.assert_array_equal(step[2], 0)


def test_without_known_gradients_steering_starts_from_elites() -> None:
    emitter = SteeringEmitter(8, max_step=1.0)
    repertoire, state = jax.device_get(begin(emitter))
    changed = repertoire.replace(fitnesses=repertoire.fitnesses + 1)
    assert not np.any(state.known(changed)) and changed.fitnesses[0, 0] == -np.inf
    genotypes = emit(emitter, changed, state)
    same = np.all(genotypes[:, None] == changed.genotypes, axis=-1)
    filled = changed.fitnesses[:, 0] > -np.inf
    assert np.all(np.any(same & filled, axis=1))
    select = compiled(lambda state, given: state.select(given, jax.random.key(2), 16))
    chosen = np.asarray(select(state, changed))
    assert filled[chosen].all()
    # with one known elite, this one alone moves, along means of halves
    (cell, *_) = np.flatnonzero(filled)
    known = np.where(np.arange(len(filled)) == cell, state.fitnesses, -np.inf)
    found = emit(emitter, repertoire, state.replace(fitnesses=known))
    halves = (found - repertoire.genotypes[cell]).reshape(-1, 2, SIZE // 2)
    np.testing.assert_allclose(halves, halves[..., :1] + 0 * halves, atol=1e-5)


def test_a_later_step_of_unknown_scores_is_none() -> None:
    def unknown(genotypes: jax.Array, key: jax.Array) -> tuple:
        fitnesses, descriptors, extra = score(genotypes, key)
        return fitnesses, descriptors + jnp.nan, extra

    one = SteeringEmitter(4, max_step=0.1)
    two = SteeringEmitter(4, max_step=0.1, steps=2, scoring_function=unknown)
    repertoire, state = begin(one)
    found, expected = (emit(emitter, repertoire, state) for emitter in (two, one))
    np.testing.assert_array_equal(found, expected)


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
    uphill = gradients_at_start()[0]
    uphill = uphill / np.linalg.norm(uphill)
    np.testing.assert_allclose(ways[:2], np.broadcast_to(uphill, (2, 3, SIZE)), 1e-4)
    # The others change the descriptors alone, which are means of halves.
    for way in ways[2:]:
        np.testing.assert_allclose(way, np.broadcast_to(way[0], way.shape), atol=1e-5)
        halves = way[0].reshape(2, -1)
        np.testing.assert_allclose(halves, halves[:, :1] * np.ones(10), atol=1e-5)


def test_lines_without_a_gradient_have_random_directions() -> None:
    rows = np.array([[np.inf, 1], [np.nan, 1], [0, 0], [3, 4]], np.float32)
    ways = np.asarray(compiled(_units)(rows, jax.random.key(0)))
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), 1, rtol=1e-6)
    np.testing.assert_allclose(ways[3], [0.6, 0.8], rtol=1e-6)

    def faulty(genotypes: Any, directions: Any, key: Any) -> EpisodeGradients:
        found = along(score)(genotypes, directions, key)
        return dataclasses.replace(found, faulty=~found.faulty)

    emitter = GradientLineEmitter(
        faulty, parents=4, branches=3, shortest=0.1, longest=0.8
    )
    repertoire, state = begin(emitter, count=1)
    told = compiled(emitter.emit)(repertoire, state, jax.random.key(1))[1]
    assert told["overflowed"].tolist() == [True] * 4


def test_lines_steer_towards_the_empty_cell() -> None:
    """Every other cell has the same individual, so each parent is this one."""
    emitter = GradientLineEmitter(
        along(score), parents=4, branches=2, shortest=0.1, longest=0.2
    )
    parent = start()[:1]
    _, place, _ = scored(parent, jax.random.key(0))
    empty = np.arange(100)[:, None] == 7
    place, cells = np.asarray(place), np.asarray(centroids())
    given: dict[str, Any] = {
        "genotypes": np.tile(parent, (100, 1)),
        "fitnesses": np.where(empty, -np.inf, 0.0).astype(np.float32),
        "descriptors": np.tile(place, (100, 1)),
        "centroids": cells,
    }
    repertoire = MapElitesRepertoire(
        **given,
        extra_scores={},
        keys_extra_scores=(),
    )
    steered = emit(emitter, repertoire, ()).reshape(4, 2, SIZE)[2:]
    found = scored(steered.reshape(-1, SIZE), jax.random.key(0))[1]
    away = np.linalg.norm(np.asarray(found) - cells[7], axis=1)
    assert np.all(away < np.linalg.norm(place - cells[7]) - 0.01)


def unbeatable(genotypes: jax.Array, key: jax.Array) -> tuple:
    """One cell, whose elite nobody beats."""
    _, descriptors, extra = score(genotypes, key)
    penalty = jnp.linalg.norm(genotypes - start()[0], axis=1)
    return -penalty, 0 * descriptors, extra


@pytest.mark.parametrize(
    ("rule", "period", "expected"),
    [
        (RestartRule.BASIC, 3, [1, 2, 0, 1, 2, 0]),
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
            return carry, (state.age[0], elite, state.cma_es.mean[0], state.restarts)

        return jax.lax.scan(step, carry, None, length=6)[1]

    ages, elite, mean, restarts = compiled(run)(start())
    assert ages.tolist() == expected
    restarted = np.asarray(ages) == 0
    assert np.all(np.asarray(elite)[restarted])
    np.testing.assert_array_equal(restarts, np.cumsum(restarted))
    np.testing.assert_array_equal(np.all(np.asarray(mean) == 0, axis=1), restarted)


def test_failed_offspring_do_not_move_the_distribution() -> None:
    emitter = CMAMEGAEmitter(score, sigma_g=0.5, batch_size=5)
    begun = emitter._strategy(2).init(jnp.float32)
    coefficients = np.full((4, 3), 100, np.float32)
    coefficients[0] = 0.5
    finite = np.array([True, False, False, False])
    scores = np.array([[1, 0, 0, 0], [-np.inf] * 4], np.float32)
    adapt = compiled(emitter._adapt)
    after, improved, _ = adapt(begun, coefficients, *scores, finite)
    assert improved and 0 < after.mean.max() <= 0.5
    # their fitness is no number, so it is above no bar
    nothing = np.zeros(4, np.float32)
    none = nothing, nothing - 5, finite & ~finite
    assert not adapt(begun, coefficients, *none)[1]
    # an individual at the bar does not enter
    equal = nothing, nothing, finite | ~finite
    assert not adapt(begun, coefficients, *equal)[1]


def test_points_draw_offspring_of_their_own_along_unit_gradients() -> None:
    emitter = CMAMEGAEmitter(score, sigma_g=0.5, batch_size=8, num_emitters=2)
    state = begin(emitter)[1]
    one, two = np.asarray(state.coefficients)
    assert np.abs(one - two).max() > 0.1
    np.testing.assert_allclose(np.linalg.norm(state.gradients, axis=-1), 1, rtol=1e-5)


def test_annealed_offspring_are_ranked_by_what_they_exceed() -> None:
    classes, values = CMAMAEGAEmitter(score, sigma_g=0.5, batch_size=5)._rank(
        jnp.array([1.0, 2.0, -3.0]), jnp.array([0.0, 3.0, -9.0])
    )
    assert not classes.any() and values.tolist() == [1, -1, 6]


def test_an_equal_fitness_is_no_improvement() -> None:
    ranked = CMAMEGAEmitter(score, sigma_g=0.5, batch_size=5)._rank(
        jnp.array([1.0, 2.0, -3.0]), jnp.array([1.0, 1.0, -jnp.inf])
    )
    assert [found.tolist() for found in ranked] == [[WORSE, IMPROVED, NEW], [0, 1, -3]]


def test_failed_offspring_are_last() -> None:
    classes, finite = jnp.array([WORSE, NEW, IMPROVED]), jnp.array([True, False, True])
    assert best_of(classes, jnp.zeros(3), finite)[0].tolist() == [2, 0, 1]


def test_offspring_that_all_failed_are_equally_good() -> None:
    values = jnp.array([jnp.nan, 1.0, -jnp.inf])
    assert best_of(jnp.ones(3), values, jnp.zeros(3, bool))[1]
    # equal values of two classes are not
    assert not best_of(jnp.array([1, 0, 1]), jnp.zeros(3), jnp.ones(3, bool))[1]


class Watched(CMAMEGAEmitter):
    """Keeps the keys that it hands out."""

    keys: list[jax.Array]

    def _begun(
        self, points: Any, descriptor_length: int, key: jax.Array, old: Any
    ) -> Any:
        self.keys.append(key)
        return super()._begun(points, descriptor_length, key, old)

    def _moved(self, state: Any, means: jax.Array, key: jax.Array) -> Any:
        self.keys.append(key)
        return super()._moved(state, means, key)

    def _scored(self, points: Any, optimizer: Any, key: jax.Array) -> Any:
        self.keys.append(key)
        return super()._scored(points, optimizer, key)


def test_no_two_draws_share_a_key(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an arborescence, from the first generation to the next state's key."""
    emitter = Watched(score, sigma_g=0.5, batch_size=8)
    select = MapElitesRepertoire.select

    def watched(repertoire: Any, key: jax.Array, *arguments: Any) -> Any:
        emitter.keys.append(key)
        return select(repertoire, key, *arguments)

    monkeypatch.setattr(MapElitesRepertoire, "select", watched)

    def run(genotypes: jax.Array) -> list[jax.Array]:
        emitter.keys = []
        fitnesses, descriptors, extra = score(genotypes, jax.random.key(0))
        repertoire = MapElitesRepertoire.init(
            genotypes, fitnesses, descriptors, centroids()
        )
        state = emitter.init(
            jax.random.key(1), repertoire, genotypes, fitnesses, descriptors, extra
        )
        offspring, _ = emitter.emit(repertoire, state, jax.random.key(2))
        fitnesses, descriptors, _ = score(offspring, jax.random.key(0))
        following = emitter.state_update(
            state, repertoire, offspring, fitnesses, descriptors
        )
        return [*emitter.keys, state.key, following.key]

    keys = {tuple(jax.random.key_data(key).tolist()) for key in compiled(run)(start())}
    assert len(keys) == 3 + 4 + 2  # in ``init``, in ``state_update``, and of the states


def test_emitting_and_updating_agree() -> None:
    # What QDax 0.5.0 gets wrong: the point must move by what was emitted.
    far = np.full(SIZE, 0.9, np.float32)
    emitter = CMAMEGAEmitter(score, sigma_g=0.5, batch_size=9, start=far)
    search = algorithm(emitter)
    repertoire, state = jax.device_get(begin(emitter))
    genotypes = emit(emitter, repertoire, state)
    fitnesses, descriptors, _ = scored(genotypes, jax.random.key(2))
    tell = compiled(search.tell)
    _, after, _ = tell(genotypes, fitnesses, descriptors, repertoire, state)
    own, *cells = np.asarray(compiled(get_cells_indices)(descriptors, centroids()))
    bars = np.asarray(state.bars)[cells]
    # offspring must beat the point too, which no archive has had
    assert repertoire.fitnesses[own] == -np.inf
    np.testing.assert_allclose(state.bars[own], fitnesses[0], rtol=1e-6)
    new = bars == -np.inf
    worth = np.asarray(fitnesses)[1:] - np.where(new, 0, bars)
    order = np.lexsort((-worth, -np.where(new, 2, worth > 0)))
    weights = np.log(4.5) - np.log(np.arange(1, 5))
    parents = np.asarray(genotypes)[1:][order[:4]]
    expected = (weights / weights.sum()) @ parents
    assert int(after.restarts) == 0
    np.testing.assert_allclose(after.points[0], expected, atol=1e-5)
    # what is not finite is counted; a point without gradients begins again
    assert int(after.rejected) == 0
    lost = np.array(fitnesses)
    lost[3] = np.nan
    state = state.replace(finite=~state.finite)
    _, after, _ = tell(genotypes, lost, descriptors, repertoire, state)
    assert [int(x) for x in (after.rejected, after.restarts, after.age[0])] == [1, 1, 0]
    # the point itself was counted when its gradients were found
    lost[0] = np.nan
    _, after, _ = tell(genotypes, lost, descriptors, repertoire, state)
    assert int(after.rejected) == 1
