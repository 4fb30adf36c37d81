"""Actors that learn over short windows, on a point that is pushed about."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_runs import PointEnv, point_task
from qdax.core.containers.mapelites_repertoire import (
    MapElitesRepertoire,
    compute_euclidean_centroids,
)

from newton_qd.extractors import get_final_xy_position
from newton_qd.qd.emitters import ActorCriticEmitter
from newton_qd.qd.emitters.actor_critic_learner import (
    ActorCritic,
    ActorCriticSettings,
    measure_of,
)
from newton_qd.qd.emitters.restarts import due_for_restart

# These programs run for milliseconds: they need no optimizer.
compiled = functools.partial(
    jax.jit, compiler_options={"xla_backend_optimization_level": 0}
)
SIZE, LENGTH = 6, 20
SETTINGS = ActorCriticSettings(
    worlds=4, window=5, rate=0.05, clip=1e6, noise=0.1, critic=(8,), batches=2
)


def policy(weights: jax.Array, obs: jax.Array) -> jax.Array:
    return jnp.tanh(obs @ weights.reshape(3, 2))


def reading(before: Any, after: Any) -> jax.Array:
    del before
    return after.pipeline_state


def method(measure: Any = reading, **changes: Any) -> ActorCritic:
    settings = dataclasses.replace(SETTINGS, **changes)
    return ActorCritic(PointEnv(), policy, measure, LENGTH, settings)


@compiled
def begun(aim: jax.Array) -> Any:
    first = jax.vmap(PointEnv().reset)(jax.random.split(jax.random.key(0), 4))
    return method().begin(jax.random.key(1), jnp.zeros(SIZE), aim, first)


def learner(aim: tuple[float, ...] = (1.0, 0.0, 0.0)) -> Any:
    """A new actor: it is the same for all settings of ``method`` that tests change."""
    return begun(np.array(aim, np.float32))


@functools.cache
def scale_of_observations() -> tuple[jax.Array, jax.Array]:
    return compiled(method().scale)(jax.random.key(2), learner().first)


def weights_of(size: float) -> jax.Array:
    return jnp.asarray(size * np.random.default_rng(4).normal(size=SIZE), jnp.float32)


def learned(way: ActorCritic, aim: tuple[float, ...], updates: int = 60) -> Any:
    start, scale = learner(aim), scale_of_observations()

    def update(carry: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        return way.update(carry, scale, key)

    keys = jax.random.split(jax.random.key(3), updates)
    return compiled(lambda: jax.lax.scan(update, start, keys))()


@compiled
def play(weights: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return of an episode, and where it ends (2,)."""
    env = PointEnv()

    def step(state: Any, _: None) -> tuple[Any, jax.Array]:
        state = env.step(state, policy(weights, state.obs))
        return state, state.reward

    state, rewards = jax.lax.scan(step, env.reset(jax.random.key(5)), length=LENGTH)
    return rewards.sum(), state.pipeline_state


def test_the_gradient_is_that_of_the_window() -> None:
    """Against rewards, measures and the last value, added up step by step."""
    way, start, scale = (
        method(noise=0.0),
        learner((1.0, 0.3, -0.2)),
        scale_of_observations(),
    )
    weights, aim = weights_of(0.3), start.aim
    world = jax.tree.map(lambda x: np.asarray(x)[0], start.first)
    discount, env = SETTINGS.discount, PointEnv()

    def by_hand(weights: jax.Array) -> jax.Array:
        state, total = world, jnp.zeros(())
        for step in range(SETTINGS.window):
            state = env.step(state, policy(weights, state.obs))
            gain = jnp.append(state.reward, state.pipeline_state) @ aim
            total += discount**step * gain
        value = way._value(start.target, scale, state.obs)
        return total + discount**SETTINGS.window * value

    def by_window(weights: jax.Array) -> jax.Array:
        noise = jnp.zeros((SETTINGS.window, 2))
        return way._window(weights, start, scale, world, world, noise)[0]

    pair = compiled(by_window)(weights), compiled(by_hand)(weights)
    np.testing.assert_allclose(*pair, rtol=1e-5)
    expected = compiled(jax.grad(by_hand))(weights)
    assert float(jnp.linalg.norm(expected)) > 0.1
    np.testing.assert_allclose(
        compiled(jax.grad(by_window))(weights), expected, rtol=1e-4, atol=1e-5
    )


def test_each_world_has_weights_of_its_own() -> None:
    """With noise on weights, each window has the policy that its noise makes."""
    way = method(noise=0.0, weight_noise=0.3)
    start, key = learner(), jax.random.key(4)
    scale, weights = scale_of_observations(), weights_of(0.3)
    rest = jnp.zeros((SETTINGS.window, 2))

    def window(weights: jax.Array, world: Any) -> jax.Array:
        return way._window(weights, start, scale, world, world, rest)[0]

    found = compiled(lambda: way._windows(weights, start, scale, key)[0])()
    shape = (SETTINGS.worlds, SIZE)
    moved = weights + 0.3 * jax.random.normal(jax.random.fold_in(key, 0), shape)
    expected = compiled(jax.vmap(window))(moved, start.first)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert np.ptp(found - compiled(jax.vmap(window, (None, 0)))(weights, start.first))


def other_critic() -> Any:
    """Weights of a critic that are not those of the start."""
    draw = np.random.default_rng(5).normal
    return jax.tree.map(
        lambda x: np.asarray(x) + draw(size=x.shape).astype(np.float32),
        learner().critic,
    )


@pytest.mark.slow
def test_values_inside_of_a_window_count() -> None:
    """The TD(lambda) return as the weighted mean of the returns of all lengths."""
    part, way = 0.7, method(noise=0.0, actor_trace=0.7)
    start = dataclasses.replace(learner(), target=other_critic())
    scale, weights = scale_of_observations(), weights_of(0.3)
    world = jax.tree.map(lambda x: np.asarray(x)[0], start.first)
    discount, env = SETTINGS.discount, PointEnv()

    def by_hand(weights: jax.Array) -> jax.Array:
        state, total, returns = world, jnp.zeros(()), []
        for step in range(SETTINGS.window):
            state = env.step(state, policy(weights, state.obs))
            total += discount**step * state.reward
            value = way._value(start.target, scale, state.obs)
            returns.append(total + discount ** (step + 1) * value)
        last = len(returns) - 1
        mean = sum((1 - part) * part**i * x for i, x in enumerate(returns[:last]))
        return mean + part**last * returns[last]

    def by_window(weights: jax.Array) -> jax.Array:
        noise = jnp.zeros((SETTINGS.window, 2))
        return way._window(weights, start, scale, world, world, noise)[0]

    pairs = (compiled(jax.value_and_grad(x))(weights) for x in (by_window, by_hand))
    for found, expected in zip(*pairs, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)


def test_the_critic_learns_td_lambda_targets() -> None:
    """The target of the first step, as the weighted mean of returns of all lengths."""
    trace, discount, way = 0.6, SETTINGS.discount, method(noise=0.0, trace=0.6)
    scale: Any = np.array([[0.1, -0.2, 0.3], [0.5, 2.0, 1.0]], np.float32)
    critic, weights = other_critic(), weights_of(0.3)
    start = dataclasses.replace(learner(), target=critic)
    world = jax.tree.map(lambda x: np.asarray(x)[0], start.first)

    def value(obs: np.ndarray) -> float:
        (first, bias), (last, offset) = critic
        hidden = np.tanh((obs - scale[0]) / scale[1] @ first + bias)
        return float((hidden @ last + offset)[0]) / (1 - discount)

    @compiled
    def both() -> Any:
        def step(state: Any, _: None) -> tuple[Any, Any]:
            state = PointEnv().step(state, policy(weights, state.obs))
            return state, (state.obs, state.reward)

        rest = jnp.zeros((SETTINGS.window, 2))
        found = way._window(weights, start, scale, world, world, rest)[1][2]
        return found, jax.lax.scan(step, world, length=SETTINGS.window)[1]

    targets, (seen, rewards) = jax.device_get(both())
    total, returns = 0.0, []
    for step, (obs, reward) in enumerate(zip(seen, rewards, strict=True)):
        total += discount**step * reward
        returns.append(total + discount ** (step + 1) * value(obs))
    parts = (1 - trace) * trace ** np.arange(SETTINGS.window)
    parts[-1] = trace ** (SETTINGS.window - 1)
    np.testing.assert_allclose(targets[0], parts @ np.array(returns), rtol=1e-4)


def test_an_update_follows_the_mean_gradient_and_moves_the_target_critic() -> None:
    way, key = method(), jax.random.key(4)
    start = dataclasses.replace(learner(), weights=jnp.full(SIZE, 0.3))
    scale: Any = np.zeros(3, np.float32), np.ones(3, np.float32)

    @compiled
    def both() -> Any:
        def total(weights: jax.Array) -> jax.Array:
            noise_key, _ = jax.random.split(key)
            return way._windows(weights, start, scale, noise_key)[0].sum()

        return way.update(start, scale, key)[0], jax.grad(total)(start.weights)

    after, slope = both()
    mean = next(x for x in jax.tree.leaves(after.moments[0]) if x.shape == (SIZE,))
    # the optimizer limits the length to 1, after the mean over control steps
    assert jnp.linalg.norm(slope / way.steps) < 1 < jnp.linalg.norm(slope)
    np.testing.assert_allclose(mean, -0.3 * slope / way.steps, rtol=1e-3, atol=1e-5)
    for new, old, fitted in zip(
        *map(jax.tree.leaves, (after.target, start.target, after.critic)), strict=True
    ):
        np.testing.assert_allclose(new, 0.8 * fitted + 0.2 * old, rtol=1e-5, atol=1e-7)


def test_the_age_of_a_world_begins_again_after_a_fall() -> None:
    right: Any = np.array([1.0, 0.0], np.float32)
    settings = dataclasses.replace(SETTINGS, window=10, noise=0.0)
    beyond = 2 * right  # clipped to 1
    way = ActorCritic(PointEnv(), lambda *_: beyond, reading, LENGTH, settings)
    start = learner((1.0, 1.0, 1.0))
    assert start.age.tolist() == [0, 5, 10, 15]
    scale: Any = np.zeros(3, np.float32), np.ones(3, np.float32)
    after, failed = compiled(way.update)(start, scale, jax.random.key(2))
    # a step is 0.3 long, and the point falls 2 away from the middle: in step 7
    assert not failed and after.age.tolist() == [3, 3, 3, 3]
    place = np.asarray(start.first.pipeline_state) + 3 * 0.3 * right
    np.testing.assert_allclose(after.worlds.pipeline_state, place, atol=1e-5)


class Over(PointEnv):
    """Every episode has one step."""

    def _state(self, position: jax.Array, reward: jax.Array) -> Any:
        state = super()._state(position, reward)
        info = {**state.info, "truncation": 1 - state.done}
        return dataclasses.replace(state, done=jnp.ones_like(state.done), info=info)


@functools.cache
def ends(window: int, beyond: bool) -> Any:
    """Compiled functions of weights and a place: what a window finds from there."""
    way = method(noise=0.0, window=window, beyond_length=beyond)
    way = dataclasses.replace(way, env=Over(), policy=lambda weights, _: weights[:2])
    start = learner()
    ones = jax.tree.map(jnp.ones_like, start.target)
    start = dataclasses.replace(start, target=ones)
    scale = jnp.zeros(3), jnp.ones(3)
    first = Over()._state(jnp.full(2, 0.1), jnp.zeros(()))

    def by_hand(weights: jax.Array, push: jax.Array, counts: jax.Array) -> jax.Array:
        world = Over()._state(jnp.full(2, push), jnp.zeros(()))
        state = PointEnv().step(world, weights[:2])
        value = way._value(start.target, scale, state.obs)
        return state.reward + counts * SETTINGS.discount * value

    def by_window(weights: jax.Array, push: jax.Array) -> tuple[jax.Array, Any]:
        noise = jnp.zeros((window, 2))
        world = Over()._state(jnp.full(2, push), jnp.zeros(()))
        return way._window(weights, start, scale, first, world, noise)

    return (
        compiled(jax.value_and_grad(by_window, has_aux=True)),
        compiled(jax.value_and_grad(by_hand)),
    )


@pytest.mark.parametrize("window", [1, 3])
@pytest.mark.parametrize("beyond", [False, True])
@pytest.mark.parametrize("push", [0.5, 8.0])
def test_the_end_of_a_whole_episode_has_a_value(
    window: int, beyond: bool, push: float
) -> None:
    """Also within a window, whose other steps belong to other episodes."""
    by_window, by_hand = ends(window, beyond)[0], ends(1, False)[1]
    counts = beyond and push < 2  # farther from the middle, the point falls
    weights, place = np.full(SIZE, 0.3, np.float32), np.float32(push)
    (total, found), slope = by_window(weights, place)
    expected, other = by_hand(weights, place, np.float32(counts))
    last, _, targets, dones = jax.device_get(found)
    np.testing.assert_allclose((total, targets[0]), expected, rtol=1e-5)
    np.testing.assert_allclose(slope, other, rtol=1e-5)
    assert dones.tolist() == [1] * window
    np.testing.assert_array_equal(last.pipeline_state, np.full(2, 0.1, np.float32))


class Blind(PointEnv):
    """Its observations are no numbers right of the middle."""

    def _state(self, position: jax.Array, reward: jax.Array) -> Any:
        state = super()._state(position, reward)
        seen = jnp.where(position[0] > 0.5, jnp.nan, state.obs)
        return dataclasses.replace(state, obs=seen)


def test_the_scale_is_that_of_observations_that_are_numbers() -> None:
    way = dataclasses.replace(method(), env=Blind())

    @compiled
    def scale() -> tuple[jax.Array, jax.Array]:
        first = jax.vmap(Blind().reset)(jax.random.split(jax.random.key(0), 4))
        return way.scale(jax.random.key(2), first)

    for found in scale():
        assert np.isfinite(found).all()


@pytest.mark.slow
def test_actors_reach_what_they_aim_at() -> None:
    best, lost = learned(method(), (1.0, 0.0, 0.0))
    assert not np.asarray(lost).any()
    assert play(jnp.zeros(SIZE))[0] < 12 < 17 < play(best.weights)[0]
    left, _ = learned(method(), (0.0, -1.0, 0.0), updates=20)
    right, _ = learned(method(), (0.0, 1.0, 0.0), updates=20)
    assert play(left.weights)[1][0] < -0.5 < 0.5 < play(right.weights)[1][0]


def test_a_gradient_that_is_not_finite_changes_no_weights() -> None:
    def half_broken(before: Any, after: Any) -> jax.Array:
        del before
        position = after.pipeline_state
        return jnp.where(position > 0.2, jnp.nan, position)

    way = method(half_broken)
    after, lost = learned(way, (1.0, 1.0, 1.0), updates=30)
    assert np.asarray(lost).any() and not np.asarray(lost).all()
    for leaf in jax.tree.leaves(after):
        assert np.isfinite(np.asarray(leaf, np.float64)).all()


class Slow(PointEnv):
    """Its control steps take half a second."""

    dt = 0.5


def test_measures_are_those_of_the_descriptor() -> None:
    before, after = (
        dataclasses.replace(
            PointEnv().reset(jax.random.key(0)),
            info={"state_descriptor": jnp.array(place)},
        )
        for place in ([1.0, 2.0], [1.5, 1.0])
    )
    task = point_task(None)  # pyright: ignore[reportArgumentType]
    np.testing.assert_array_equal(measure_of(task)(before, after), [1.5, 1.0])
    final = get_final_xy_position
    task = dataclasses.replace(task, env=Slow(), descriptor_extractor=final)
    np.testing.assert_array_equal(measure_of(task)(before, after), [1.0, -2.0])


def emitter(measure: Any = reading, **changes: Any) -> ActorCriticEmitter:
    given = {"actors": 3, "branches": 2, "copies": 4, "updates": 2, "lifetime": 2}
    first = PointEnv().reset(jax.random.key(0))
    options: Any = {**given, "steered": 0.7, "measures": 2, **changes}
    return ActorCriticEmitter(method(measure), first, **options)


def broken(before: Any, after: Any) -> jax.Array:
    del before
    return jnp.where(after.pipeline_state > -9, jnp.nan, 0)


@functools.cache
def parts(measure: Any = reading) -> tuple[ActorCriticEmitter, Any, Any, Any]:
    """An emitter, and its compiled functions."""
    made = emitter(measure)
    return made, compiled(made.init), compiled(made.emit), compiled(made.state_update)


@functools.cache
def initial() -> tuple[MapElitesRepertoire, tuple[jax.Array, ...]]:
    """Repertoire, genotypes, fitnesses and descriptors of the first actors."""

    def begin() -> Any:
        cells = compute_euclidean_centroids((4, 4), [-2.0, -2.0], [2.0, 2.0])
        genotypes = 0.1 * jax.random.normal(jax.random.key(0), (16, SIZE), jnp.float32)
        # a program inside of another one has no options of its own
        fitnesses, found = jax.vmap(inspect.unwrap(play))(genotypes)
        given = genotypes, fitnesses, found
        return MapElitesRepertoire.init(*given, cells, {}), given

    return compiled(begin)()


def generations(number: int, measure: Any = reading) -> list[tuple[Any, Any, Any]]:
    """State, individuals and what is told of them, of each generation."""
    _, init, emit, update = parts(measure)
    repertoire, given = initial()
    state = init(jax.random.key(1), repertoire, *given, {})
    rows = []
    for generation in range(number):
        offspring, told = emit(repertoire, state, jax.random.key(generation))
        rows.append((state, offspring, told))
        state = update(state, repertoire)
    return rows


@pytest.mark.slow
def test_individuals_are_actors_and_what_lies_between_them_and_elites() -> None:
    made, rows = parts()[0], generations(3)
    for state, offspring, told in rows:
        assert offspring.shape == (made.batch_size, SIZE) == (24, SIZE)
        assert offspring.dtype == jnp.float32
        snapshots = state.snapshots.reshape(-1, SIZE)
        np.testing.assert_array_equal(offspring[:6], snapshots)
        assert told["overflowed"].shape == (3,)
    last = rows[-1][0]
    np.testing.assert_array_equal(last.snapshots[-1], last.learners.weights)


def test_a_single_copy_is_the_actor_itself() -> None:
    archive, state = initial()[0], generations(1)[0][0]
    offspring, _ = compiled(emitter(copies=1).emit)(archive, state, jax.random.key(0))
    np.testing.assert_array_equal(offspring, state.snapshots.reshape(-1, SIZE))


def test_noise_of_offspring_is_log_uniform() -> None:
    """Actors and elites are equal, so there is nothing but noise between them."""
    state = generations(1)[0][0]
    point = np.asarray(state.snapshots)[0, 0]
    state = dataclasses.replace(state, snapshots=np.tile(point, (2, 3, 1)))
    archive: Any = initial()[0].replace(
        genotypes=np.tile(point, (16, 1)), fitnesses=np.zeros((16, 1), np.float32)
    )
    made = emitter(copies=100, spread=(1e-3, 1.0))
    offspring = np.asarray(compiled(made.emit)(archive, state, jax.random.key(0))[0])[
        6:
    ]
    tens = np.log10(np.sqrt(np.mean(np.square(offspring - point), axis=1)))
    assert tens.min() < -2.7 and -0.3 < tens.max()
    assert abs(np.median(tens) + 1.5) < 0.3


def test_steered_actors_begin_again() -> None:
    states = [state for state, *_ in generations(6)]
    assert max(state.learners.age.max() for state in states) < LENGTH
    aims = np.stack([state.learners.aim for state in states])
    # one of three climbs and keeps its aim; the others follow directions in turn
    np.testing.assert_array_equal(aims[:, 0], np.tile([1.0, 0.0, 0.0], (6, 1)))
    np.testing.assert_allclose(np.linalg.norm(aims[:, 1:, 1:], axis=2), 1, rtol=1e-6)
    changed = (np.diff(aims, axis=0) != 0).any(axis=2)
    assert changed[:, 1].sum() == changed[:, 2].sum() == 2
    assert not (changed[:, 1] & changed[:, 2]).any()
    # only with a new direction, the four updates of a generation do not go on
    moments = [jax.tree.leaves(state.learners.moments[0]) for state in states]
    counts = np.stack([next(x for x in one if x.dtype == jnp.int32) for one in moments])
    np.testing.assert_array_equal(np.diff(counts, axis=0) != 4, changed)


def test_a_long_life_is_counted_in_64_bits() -> None:
    # 63 * 2**30 has more than 32 bits
    for generation in (1, 2**24, 2**30 - 1):
        due = due_for_restart(jnp.int32(generation), 2**30, 64)
        ages = (generation + np.arange(64) * 2**24) % 2**30
        np.testing.assert_array_equal(due, ages == 0)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_directions_can_lead_to_empty_cells(share: float) -> None:
    archive: Any
    made = emitter(actors=4, steered=1.0, lifetime=1, to_empty=share)
    archive, given = initial()
    state = compiled(made.init)(jax.random.key(1), archive, *given, {})
    state = dataclasses.replace(state, generation=jnp.ones((), jnp.int32))
    actors = compiled(made._renewed)(state, archive, jax.random.key(5))
    empty = np.asarray(archive.fitnesses)[:, 0] == -np.inf
    assert 0 < empty.sum() < len(empty)
    for weights, aim in zip(actors.weights, np.asarray(actors.aim), strict=True):
        (cell,) = np.flatnonzero((archive.genotypes == weights).all(axis=1) & ~empty)
        ways = archive.centroids - archive.descriptors[cell]
        ways = ways / jnp.linalg.norm(ways, axis=1, keepdims=True)
        leads = np.abs(ways - aim[1:]).max(axis=1) < 1e-5
        assert leads[empty].any() == (share == 1.0)
        assert aim[0] == np.float32(0.1)


def test_equal_keys_give_equal_bits() -> None:
    one, two = (generations(3)[-1] for _ in range(2))
    np.testing.assert_array_equal(one[1], two[1])


def test_lost_gradients_are_told() -> None:
    state, offspring, told = generations(2, broken)[-1]
    np.testing.assert_array_equal(told["overflowed"], 4)
    assert np.isfinite(offspring).all() and np.isfinite(state.snapshots).all()
    assert not state.learners.age.any(), "worlds restart"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"actors": 0}, "actors: got 0; allowed: .* from 1"),
        ({"copies": 0}, "copies: got 0; allowed: .* from 1"),
        ({"lifetime": 0}, "lifetime: got 0; allowed: .* from 1"),
        ({"lifetime": 2**31}, "lifetime: got 2147483648; allowed: .* 1073741824"),
        ({"spread": (0.1, 0.01)}, r"spread: got \(0.1, .*; .*0 < smallest <= largest"),
        ({"steered": -0.1}, "steered: got -0.1; .* from 0 to 1"),
        ({"to_empty": 1.1}, "to_empty: got 1.1; .* from 0 to 1"),
    ],
)
def test_bad_numbers_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        emitter(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"window": 0}, "window: got 0; allowed: .* from 1"),
        ({"batches": 21}, r"batches: got 21; .*at most worlds \* window = 20"),
        ({"clip": 0.0}, "clip: got 0.0; allowed: finite .*above 0"),
        ({"critic": (8, 0)}, r"critic\[1\]: got 0; allowed: integers from 1"),
        ({"noise": -1.0}, "noise: got -1.0; allowed: .* from 0"),
        ({"trace": 2.0}, "trace: got 2.0; allowed: .* from 0 to 1"),
        ({"actor_trace": 2.0}, "actor_trace: got 2.0; allowed: .* from 0 to 1"),
    ],
)
def test_bad_settings_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        method(**changes)


def test_settings_of_a_wrong_type_are_refused() -> None:
    with pytest.raises(TypeError, match="whiten: got 'no'; allowed: True, False"):
        method(whiten="no")
    with pytest.raises(TypeError, match="critic: got 8; allowed: a tuple of integers"):
        method(critic=8)
