"""One actor that is told the target descriptor, on a point that is pushed about."""

from __future__ import annotations

import dataclasses
import functools
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_runs import SMALL, PointEnv, point_task
from qdax.core.containers.mapelites_repertoire import (
    MapElitesRepertoire,
    compute_euclidean_centroids,
)
from test_actor_critic import SETTINGS, compiled

from newton_qd.extractors import get_final_xy_position
from newton_qd.qd.algorithms.me_conditioned import ME_CONDITIONED
from newton_qd.qd.config import ConfigError
from newton_qd.qd.emitters import ActorCritic, ConditionedActorEmitter
from newton_qd.qd.emitters.aims import AimedEnv, ConditionedPolicy, no_measure
from newton_qd.qd.emitters.conditioned import _spread
from newton_qd.qd.run.search import Search
from newton_qd.qd.scoring.rollout import Policy, make_policy

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

LENGTH = 10


class Placed(PointEnv):
    """The descriptor is where the point is, which has a gradient."""

    dt = 1.0
    fault_beyond = 9.0

    def _state(self, position: jax.Array, reward: jax.Array) -> Any:
        state = super()._state(position, reward)
        info = {**state.info, "state_descriptor": position}
        return dataclasses.replace(state, info=info)


@functools.cache
def task(final: bool = False) -> Any:
    given = point_task(None, Placed())  # pyright: ignore[reportArgumentType]
    limits = np.array([-1, -1], np.float32), np.array([3, 1], np.float32)
    given = dataclasses.replace(given, limits=limits)
    if final:
        return dataclasses.replace(given, descriptor_extractor=get_final_xy_position)
    return given


@functools.cache
def policy() -> Policy:
    return make_policy(Placed(), (4,))


def scaled(places: Any) -> np.ndarray:
    return (np.asarray(places) - [1, 0]) / [2, 1]


@pytest.mark.parametrize("final", [False, True])
def test_rewards_add_up_to_the_distance_of_the_descriptor(final: bool) -> None:
    env, target = AimedEnv(task(final), LENGTH), jnp.float32([0.4, -0.7])
    first = Placed().reset(jax.random.key(1))
    weights = jnp.float32([0.25, 0.5])
    actions = jax.random.uniform(jax.random.key(2), (LENGTH, 2), minval=-0.4)

    def advance(state: Any, action: jax.Array) -> tuple[Any, tuple]:
        state = env.step(state, action)
        place = state.info["state_descriptor"]
        return state, (place, state.state.reward, state.reward)

    def episode() -> Any:
        start = env.aimed(first, target, weights)
        return start, *jax.lax.scan(advance, start, actions)

    start, last, (places, plain, rewards) = compiled(episode)()
    reached = scaled(places)[-1] if final else scaled(places).mean(axis=0)
    np.testing.assert_allclose(last.error, reached - target, atol=1e-5)
    placed = scaled(first.info["state_descriptor"]) - target
    np.testing.assert_allclose(start.error, placed if final else [0, 0], atol=1e-6)
    begun = np.linalg.norm(start.error)
    nearer = begun - np.linalg.norm(reached - target)
    expected = 0.25 * np.sum(plain) + 0.5 * LENGTH * nearer
    assert float(np.sum(rewards)) == pytest.approx(float(expected), abs=0.02)
    parts = (last.state.obs, target, last.error, weights[1:])
    np.testing.assert_array_equal(last.obs, np.concatenate(parts))
    assert last.obs.shape == (env.observation_size,)


def test_a_fall_does_not_come_nearer() -> None:
    """The point leaves its circle; its error stays, and a fall is paid for."""
    env, weights = AimedEnv(task(), LENGTH), jnp.float32([0, 0.5])
    first = Placed()._state(jnp.float32([0, 1.9]), jnp.float32(0))
    state = env.aimed(first, jnp.zeros(2), weights)
    inside, outside = (env.step(state, jnp.float32([0, x])) for x in (0.0, 1.0))
    assert float(inside.done) == 0 and float(outside.done) == 1
    steps_away = 30 * 2**0.5  # each of them as far as a corner
    assert float(outside.reward) < float(inside.reward) - 0.5 * steps_away


class Counted(Placed):
    """An episode that is over by its length alone."""

    def step(self, state: Any, action: jax.Array) -> Any:
        after, one = super().step(state, action), jnp.ones((), jnp.float32)
        info = {**after.info, "truncation": one - after.done}
        return dataclasses.replace(after, done=one, info=info)


def test_the_length_of_an_episode_is_no_fall() -> None:
    env: Any = Counted()
    weights, action = jnp.float32([0, 0.5]), jnp.float32([0, 0])
    first = env._state(jnp.float32([0, 1.9]), jnp.float32(0))
    rewards = []
    for world in (env, Placed()):
        aimed = AimedEnv(dataclasses.replace(task(), env=world), LENGTH)
        state = aimed.aimed(first, jnp.zeros(2), weights)
        rewards.append(aimed.step(state, action).reward)
        fallen = aimed.step(state, jnp.float32([0, 1.0]))
        assert float(fallen.reward) < float(rewards[-1]) - 0.5 * 30 * 2**0.5
    assert float(rewards[0]) == float(rewards[1])


def test_an_actor_is_a_policy_of_the_archive_for_each_target() -> None:
    """The perceptron of observation and target, written out."""
    own = ConditionedPolicy(policy(), 2)
    actor = jax.random.normal(jax.random.key(0), (own.size,))
    assert own.size == policy().size + 2 * 4
    obs, target = jnp.float32([0.3, -0.2, 1.0]), jnp.float32([0.5, -0.8])
    layers = policy().unravel(actor[: policy().size])["params"]
    more = actor[policy().size :].reshape(2, 4)
    kernel = np.concatenate([layers["Dense_0"]["kernel"], more])
    inner = np.concatenate([obs, target]) @ kernel + layers["Dense_0"]["bias"]
    outer = np.maximum(inner, 0) @ layers["Dense_1"]["kernel"]
    expected = np.tanh(outer + layers["Dense_1"]["bias"])
    told = jnp.concatenate([obs, target, jnp.zeros(3)])
    np.testing.assert_allclose(own.act(actor, told), expected, atol=1e-5)
    special = own.specialized(actor, target)
    np.testing.assert_allclose(policy().of_weights(special, obs), expected, atol=1e-5)
    start = own.unconditioned(special)
    np.testing.assert_array_equal(own.specialized(start, target), special)


def emitter(**changes: Any) -> ConditionedActorEmitter:
    env, own = AimedEnv(task(), LENGTH), ConditionedPolicy(policy(), 2)
    settings = dataclasses.replace(SETTINGS, worlds=6, rate=0.02)
    given = {"copies": 4, "between": 3, "updates": 2, "empty": 0.5, **changes}
    method = ActorCritic(env, own.act, no_measure, LENGTH, settings)
    first = Placed().reset(jax.random.key(0))
    options: Any = given
    return ConditionedActorEmitter(method, env, own, first, **options)


@functools.cache
def parts() -> tuple[ConditionedActorEmitter, Any, Any, Any]:
    """An emitter, and its compiled functions."""
    made = emitter()
    return made, compiled(made.init), compiled(made.emit), compiled(made.state_update)


def begun() -> tuple[Any, Any]:
    """An archive of 4 x 4 cells with three elites, and the emitter's first state."""
    cells = compute_euclidean_centroids((4, 4), [-1.0, -1.0], [3.0, 1.0])
    genotypes = jax.vmap(policy().init)(jax.random.split(jax.random.key(0), 3))
    found = jnp.float32([[-0.5, -0.8], [0.4, 0.1], [2.9, 0.9]])
    fitnesses = jnp.float32([1.0, 7.0, 3.0])
    held = MapElitesRepertoire.init(genotypes, fitnesses, found, cells, {})
    state = parts()[1](jax.random.key(1), held, genotypes, fitnesses, found, {})
    return held, state


@functools.cache
def begun_without_worlds() -> Any:
    """First state for an archive's fitnesses; the worlds take long to compile."""
    made: Any = emitter()
    made._method = types.SimpleNamespace(episode_length=LENGTH, begin=lambda *_: None)
    made._worlds = made._scale = lambda *_: None

    def begin(fitnesses: jax.Array) -> Any:
        cells = compute_euclidean_centroids((2, 2), [-1.0, -1.0], [3.0, 1.0])
        genotypes = jnp.zeros((3, policy().size))
        found = jnp.float32([[-0.5, -0.8], [0.4, 0.1], [2.9, 0.9]])
        held = MapElitesRepertoire.init(genotypes, fitnesses, found, cells, {})
        return made.init(jax.random.key(1), held, genotypes, fitnesses, found, {})

    return compiled(begin)


@pytest.mark.parametrize(
    ("fitnesses", "unit"),
    [
        ([1.0, 7.0, 3.0], np.std([1, 7, 3])),
        ([1.0, -np.inf, 3.0], 1.0),
        ([-np.inf, -np.inf, 3.0], 1e-6 * LENGTH),
        ([-np.inf] * 3, 1e-6 * LENGTH),
    ],
)
def test_the_unit_is_the_deviation_of_what_is_finite(
    fitnesses: list[float], unit: float
) -> None:
    state = begun_without_worlds()(np.array(fitnesses, np.float32))
    np.testing.assert_allclose(state.unit, unit, rtol=1e-6)


def test_an_archive_without_elites_has_no_spread() -> None:
    assert float(_spread(jnp.full(4, -jnp.inf))) == 0
    assert float(_spread(jnp.float32([2.0, -jnp.inf, 4.0]))) == 1


@jax.tree_util.register_dataclass
@dataclasses.dataclass
class Idle:
    """A learner that learns nothing."""

    first: jax.Array


def test_the_unit_is_the_largest_deviation_so_far() -> None:
    made: Any = emitter()
    made._method = types.SimpleNamespace(update=lambda learner, *_: (learner, 0))
    made._worlds = lambda *_: jnp.zeros(1)
    state = types.SimpleNamespace(
        learner=Idle(jnp.zeros(1)),
        scale=None,
        unit=jnp.float32(2.0),
        logits=jnp.zeros(4),
        cells=jnp.zeros(4, jnp.int32),
        failed=jnp.zeros((), jnp.int32),
        key=jax.random.key(0),
    )

    @compiled
    def later(fitnesses: jax.Array) -> jax.Array:
        held = grid(2)
        held = held.replace(fitnesses=held.fitnesses.at[:3, 0].set(fitnesses))
        told = {"fitnesses": jnp.ones(4), "descriptors": jnp.zeros((4, 2))}
        return made.state_update(state, held, **told).unit

    several = later(jnp.float32([1.0, 7.0, 3.0]))
    np.testing.assert_allclose(several, np.std([1, 7, 3]), rtol=1e-6)
    assert later(jnp.ones(3)) == 2


def grid(count: int) -> MapElitesRepertoire:
    """An archive of (count, count) cells with one elite, in the first of them."""
    cells = compute_euclidean_centroids((count, count), [-1.0, -1.0], [3.0, 1.0])
    held = MapElitesRepertoire.init_default(genotype=jnp.zeros(2), centroids=cells)
    return held.replace(fitnesses=held.fitnesses.at[0, 0].set(1.0))


def targets(made: Any, held: MapElitesRepertoire, key: jax.Array, count: int) -> Any:
    return compiled(lambda held, key: made._targets(held, key, count))(held, key)


def test_multipliers_stay_within_bounds() -> None:
    made, held = emitter(), grid(2)
    logits = jnp.array([6.0, 5.9, 0.0, -6.0])
    state = types.SimpleNamespace(logits=logits, cells=jnp.arange(4))
    places = held.centroids.at[:3].add(5.0)  # the last one hits
    found = made._multipliers(state, held, places, jnp.zeros(4))
    np.testing.assert_allclose(found, [6.0, 6.0, 0.3, -6.0], rtol=1e-6)


def test_multipliers_do_not_count_faulty_copies() -> None:
    """The descriptor of a faulty individual may be finite."""
    made, held = emitter(), grid(2)
    state = types.SimpleNamespace(logits=jnp.zeros(4), cells=jnp.arange(4))
    fitnesses = jnp.float32([1.0, -jnp.inf, 1.0, -jnp.inf])
    found = made._multipliers(state, held, held.centroids, fitnesses)
    np.testing.assert_allclose(found, [-0.3, 0, -0.3, 0], rtol=1e-6)
    assert ME_CONDITIONED.takes_faulty  # else fitnesses are finite in a run


def test_a_return_of_one_unit_weighs_as_much_as_half_of_the_extent() -> None:
    made: Any = emitter()
    held, key, logits = grid(2), jax.random.key(0), jnp.array([0.5, -1.0, 2.0, 0.0])
    worlds = compiled(made._worlds)(held, logits, jnp.float32(3.0), key)
    cells = np.asarray(targets(made, held, key, 6))
    share = 1 / (1 + np.exp(-np.asarray(logits)[cells]))
    expected = [(1 - share) * LENGTH / 3, share]
    np.testing.assert_allclose(worlds.weights.T, expected, rtol=1e-5)
    # targets are from -1 to 1, whatever random actions show of them
    made._method = types.SimpleNamespace(scale=lambda *_: (jnp.ones(8), jnp.ones(8)))
    for found, known in zip(made._scale(key, worlds), (0, 0.5), strict=True):
        assert found.tolist() == [1] * 3 + [known] * 5


def test_offspring_lie_between_an_elite_and_the_policy_for_its_descriptor() -> None:
    made = emitter(copies=0, spread=(1e-9, 1e-9))
    elite, place = jnp.ones(policy().size), jnp.float32([0.9, -0.3])
    actor = jax.random.normal(jax.random.key(0), (made._policy.size,))
    held = grid(2).replace(  # the place is not the centre of its cell
        genotypes=np.tile(elite, (4, 1)), descriptors=np.tile(place, (4, 1))
    )
    learner, none = types.SimpleNamespace(weights=actor), jnp.zeros(0, jnp.int32)
    state = types.SimpleNamespace(learner=learner, scale=None, cells=none, failed=None)
    emit = compiled(lambda held: made.emit(held, state, jax.random.key(1))[0])  # pyright: ignore[reportArgumentType]
    found = np.asarray(emit(held))
    told = np.asarray(made._policy.specialized(actor, jnp.float32(scaled(place))))
    way = np.asarray(elite) - told
    parts = (found - told) @ way / (way @ way)
    assert ((parts > 0) & (parts < 1)).all() and len(set(parts)) == 3
    np.testing.assert_allclose(found, told + parts[:, None] * way, atol=1e-5)


def test_empty_targets_are_near_elites() -> None:
    made, held = emitter(empty=1.0), grid(8)
    cells = np.asarray(targets(made, held, jax.random.key(0), 16))
    place = np.asarray(held.centroids)
    away = np.linalg.norm(place - place[0], axis=1)
    assert cells.min() > 0 and away[cells].mean() < 0.6 * away[1:].mean()


@pytest.mark.slow
def test_the_actor_starts_as_the_best_for_every_target() -> None:
    held, state = begun()
    best = held.genotypes[jnp.argmax(held.fitnesses[:, 0])]
    offspring, told = parts()[2](held, state, jax.random.key(0))
    assert offspring.shape == (parts()[0].batch_size, policy().size)
    np.testing.assert_array_equal(offspring[:4], np.tile(best, (4, 1)))
    np.testing.assert_array_equal(told["overflowed"], [0])


@pytest.mark.slow
def test_targets_are_elites_and_empty_cells_near_them() -> None:
    held, state = begun()
    filled = np.asarray(held.fitnesses[:, 0]) > -np.inf
    wanted = np.asarray(state.cells)
    assert filled[wanted[:2]].all() and not filled[wanted[2:]].any()
    targets = np.asarray(state.learner.first.target)
    known = scaled(held.centroids)
    assert np.abs(targets[:, None] - known).max(axis=2).min(axis=1).max() < 1e-6
    assert (np.abs(targets).max(axis=1) <= 1).all()


@pytest.mark.slow
def test_multipliers_rise_where_policies_miss() -> None:
    held, state = begun()
    places = np.array(held.centroids[state.cells])
    places[0] += 1.5  # misses; the others hit, the last one is broken
    places[3] = np.nan
    after = parts()[3](state, held, None, jnp.zeros(7), jnp.asarray(places), {})
    change = np.zeros(16)
    np.add.at(change, np.asarray(state.cells), [0.3, -0.3, -0.3, 0.0])
    np.testing.assert_allclose(after.logits, change, atol=1e-6)
    share = np.asarray(after.learner.first.weights[:, 1])
    assert ((0.42 < share) & (share < 0.58)).all()


@pytest.mark.slow
def test_an_update_tells_targets_apart() -> None:
    held, state = begun()
    places = held.centroids[state.cells]
    for _ in range(3):
        state = parts()[3](state, held, None, jnp.zeros(7), places, {})
    assert int(state.failed[0]) == 0
    offspring, _ = parts()[2](held, state, jax.random.key(0))
    specialize = parts()[0]._policy.specialized
    targets = jnp.float32(scaled(held.centroids[state.cells]))
    expected = jax.vmap(specialize, (None, 0))(state.learner.weights, targets)
    np.testing.assert_allclose(offspring[:4], expected, atol=1e-6)
    assert len(np.unique(np.asarray(offspring[:4]), axis=0)) == len(
        np.unique(state.cells)
    )


@pytest.mark.slow
def test_an_actor_reaches_its_targets() -> None:
    """Final positions, with the distance alone: three corners, one actor."""
    wide = make_policy(Placed(), (16,))
    env, own = AimedEnv(task(final=True), LENGTH), ConditionedPolicy(wide, 2)
    settings = dataclasses.replace(SETTINGS, worlds=6, rate=0.01)
    method = ActorCritic(env, own.act, no_measure, LENGTH, settings)
    first = Placed().reset(jax.random.key(0))
    targets = jnp.float32([[-0.8, -0.7], [0.1, 0.7], [-0.8, 0.7]] * 2)
    weights = jnp.tile(jnp.float32([0, 1]), (6, 1))
    worlds = jax.vmap(env.aimed, (None, 0, 0))(first, targets, weights)
    actor = own.unconditioned(wide.init(jax.random.key(3)))
    start = method.begin(jax.random.key(1), actor, jnp.ones(1), worlds)

    def distances(actor: jax.Array) -> jax.Array:
        def step(state: Any, _: None) -> tuple[Any, None]:
            action = jax.vmap(own.act, (None, 0))(actor, state.obs)
            return jax.vmap(env.step)(state, action), None

        last = jax.lax.scan(step, worlds, length=LENGTH)[0]
        return jnp.linalg.norm(last.error, axis=1)

    def learn(carry: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        scale = jnp.zeros(8), jnp.ones(8)
        return method.update(carry, scale, key)

    keys = jax.random.split(jax.random.key(2), 300)
    learned, lost = compiled(lambda: jax.lax.scan(learn, start, keys))()
    assert not np.asarray(lost).any()
    before, after = compiled(jax.vmap(distances))(jnp.stack([actor, learned.weights]))
    assert before.min() > 1 and after.max() < 0.35


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"copies": -1}, "copies: got -1; allowed: .* from 0"),
        ({"copies": 0, "between": 0}, r"copies, between: got \(0, 0\); .* least 1"),
        ({"updates": 0}, "updates: got 0; allowed: .* from 1"),
        ({"spread": (0.1, 0.01)}, r"spread: got \(0.1, .*; .*0 < smallest <= largest"),
        ({"empty": 1.1}, "empty: got 1.1; allowed: .* from 0 to 1"),
        ({"tolerance": 0.0}, "tolerance: got 0.0; allowed: .*above 0"),
        ({"dual_rate": -1.0}, "dual_rate: got -1.0; allowed: .* from 0"),
    ],
)
def test_bad_numbers_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        emitter(**changes)


@pytest.mark.slow
def test_without_conditioning_copies_are_equal() -> None:
    made = emitter(conditioned=False)
    held, state = begun()
    worlds = made._worlds(held, state.logits, state.unit, jax.random.key(0))
    np.testing.assert_array_equal(worlds.target, 0)
    np.testing.assert_array_equal(worlds.weights[:, 1], 0)


def test_a_network_of_ones_own_is_refused() -> None:
    config = SMALL.replace(algorithm="me-conditioned")
    own = dataclasses.replace(
        point_task(config),
        network=lambda key: jax.tree_util.Partial(jnp.dot, jnp.ones((2, 3))),
    )
    text = "algorithm: got 'me-conditioned', which needs the default network; allowed:"
    with pytest.raises(ConfigError, match=text):
        Search(config, own)
