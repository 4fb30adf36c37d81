"""The ASCII operator, against its definition, on a point that is pushed about."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from qdax.core.containers.mapelites_repertoire import (
    MapElitesRepertoire,
    compute_euclidean_centroids,
)

from newton_qd.qd.emitters import (
    AsciiEmitter,
    ExactAsciiEmitter,
    Interpolation,
    ascii,
)
from newton_qd.qd.emitters.ascii import improved
from newton_qd.qd.emitters.behaviors import (
    Behavior,
    behavior_of,
    interpolated,
    preference,
)

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

# These programs run for milliseconds: they need no optimizer.
compiled = functools.partial(
    jax.jit, compiler_options={"xla_backend_optimization_level": 0}
)
SIZE, LENGTH, POLICIES = 6, 7, 4
SETTINGS = Interpolation(epochs=3, deviation=0.5, clip=0.2, similarity=0.25)
RATE, DISCOUNT = 0.05, 0.9


def policy(weights: jax.Array, obs: jax.Array) -> jax.Array:
    return jnp.tanh(obs @ weights.reshape(3, 2))


def steps(seed: int = 0) -> dict[str, np.ndarray]:
    """Transitions of four policies; one is over after 5 steps, one is broken."""
    draw = np.random.default_rng(seed).normal
    dones = np.zeros((POLICIES, 2 * LENGTH), np.float32)
    dones[1, 4] = dones[1, 9] = 1
    found = {
        "obs": draw(size=(POLICIES, 2 * LENGTH, 3)).astype(np.float32),
        "actions": np.tanh(draw(size=(POLICIES, 2 * LENGTH, 2))).astype(np.float32),
        "rewards": draw(size=(POLICIES, 2 * LENGTH)).astype(np.float32),
        "dones": dones,
    }
    found["obs"][3, 2] = np.nan
    return found


@functools.cache
def behaviors() -> Any:
    """From transitions, as NumPy's: JAX would compile every slice of it."""
    found = compiled(lambda x: behavior_of(x, LENGTH, DISCOUNT))
    return lambda x: jax.device_get(found(x))


def seen(seed: int = 0) -> Behavior:
    return behaviors()(steps(seed))


def test_returns_are_sums_of_later_rewards() -> None:
    found, given = seen(), steps()
    for row, last in ((0, LENGTH), (1, 5), (2, LENGTH), (3, 0)):
        expected = np.zeros(LENGTH)
        for begin in range(last):
            for step in range(begin, last):
                gain = DISCOUNT ** (step - begin) * given["rewards"][row, step]
                expected[begin] += gain
        np.testing.assert_allclose(found.returns[row], expected, rtol=1e-4, atol=1e-6)
        np.testing.assert_array_equal(found.counts[row], np.arange(LENGTH) < last)
    np.testing.assert_array_equal(found.obs[0], given["obs"][0, :LENGTH])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


def row(found: Behavior, index: Any) -> Behavior:
    return jax.tree.map(lambda leaf: leaf[index], found)


def defined_preference(own: Behavior, other: Behavior) -> np.ndarray:
    """The definition, step by step."""
    found = np.zeros(LENGTH)
    for step in range(LENGTH):
        one, two = np.asarray(own.obs[step]), np.asarray(other.obs[step])
        cosine = one @ two / np.linalg.norm(one) / np.linalg.norm(two)
        cosine = max(cosine, 0.25) if own.counts[step] else 0.25
        gain = float(other.returns[step]) - float(own.returns[step])
        found[step] = cosine * gain * float(other.counts[step])
    return found


@pytest.mark.parametrize(("own", "other"), [(0, 2), (1, 0), (1, 2), (0, 1)])
def test_preference_is_similarity_times_the_gain_in_return(
    own: int, other: int
) -> None:
    pair = row(seen(), own), row(seen(), other)
    found = preference(*pair, 0.25)
    np.testing.assert_allclose(found, defined_preference(*pair), rtol=1e-4, atol=1e-6)
    assert (np.asarray(found) != 0).any()


def test_a_broken_behavior_moves_nobody() -> None:
    np.testing.assert_array_equal(preference(row(seen(), 0), row(seen(), 3), 0.25), 0)


def defined_offspring(
    weights: np.ndarray, behavior: Behavior, preferred: np.ndarray
) -> np.ndarray:
    """The definition: Jacobian times change of behavior, and Adam by hand."""
    theta = np.array(weights, np.float64)
    obs, wanted = (np.asarray(x, np.float64) for x in (behavior.obs, behavior.actions))
    first, second = np.zeros(SIZE), np.zeros(SIZE)
    for epoch in range(1, SETTINGS.epochs + 1):
        slope = np.zeros(SIZE)
        for step in range(LENGTH):
            action = np.tanh(obs[step] @ theta.reshape(3, 2))
            missing = wanted[step] - action
            ratio = np.exp(-missing @ missing / (2 * SETTINGS.deviation**2))
            if preferred[step] < 0 and ratio < 1 - SETTINGS.clip:
                continue  # far enough away
            change = preferred[step] * ratio * missing / SETTINGS.deviation**2
            jacobian = np.zeros((2, SIZE))
            for output in range(2):
                for entry in range(3):
                    inner = (1 - action[output] ** 2) * obs[step, entry]
                    jacobian[output, 2 * entry + output] = inner
            slope += change @ jacobian / LENGTH
        first = 0.9 * first + 0.1 * slope
        second = 0.999 * second + 0.001 * slope**2
        mean = first / (1 - 0.9**epoch)
        theta += RATE * mean / (np.sqrt(second / (1 - 0.999**epoch)) + 1e-8)
    return theta


@functools.cache
def vary() -> Any:
    return compiled(
        lambda weights, behavior, preferred: interpolated(
            policy, weights, behavior, preferred, RATE, SETTINGS
        )
    )


@pytest.mark.parametrize("scale", [0.0, 0.3, 2.0])
def test_the_operator_is_that_of_its_definition(scale: float) -> None:
    own, other = row(seen(), 0), row(seen(), 2)
    preferred = defined_preference(own, other) - 1.0
    assert (preferred > 0).any() and (preferred < 0).any()
    weights = scale * np.random.default_rng(1).normal(size=SIZE)
    found = vary()(jnp.float32(weights), other, jnp.float32(preferred))
    expected = defined_offspring(weights, other, preferred)
    assert np.abs(expected - weights).max() > RATE
    np.testing.assert_allclose(found, expected, atol=2e-4)


def test_no_preference_moves_no_weights() -> None:
    weights = jnp.ones(SIZE)
    found = vary()(weights, row(seen(), 2), jnp.zeros(LENGTH))
    np.testing.assert_array_equal(found, weights)


def told(seed: int = 0) -> tuple[Any, ...]:
    """Genotypes, fitnesses, descriptors and extra scores of a generation."""
    draw = np.random.default_rng(100 + seed).normal(size=(POLICIES, SIZE))
    fitnesses = jnp.arange(4, dtype=jnp.float32) + 10 * seed
    places = jnp.array([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9], [0.9, 0.9]], jnp.float32)
    return jnp.float32(draw), fitnesses, places, {"transitions": steps(seed)}


def begun() -> tuple[AsciiEmitter, Any, Any]:
    made = AsciiEmitter(
        policy,
        SETTINGS,
        batch_size=5,
        episode_length=LENGTH,
        rate=RATE,
        discount=DISCOUNT,
    )
    genotypes, fitnesses, places, _ = told()
    cells = compute_euclidean_centroids((2, 2), [0.0, 0.0], [1.0, 1.0])
    archive = compiled(MapElitesRepertoire.init)
    held = archive(genotypes, fitnesses, places, cells, {})
    return made, held, compiled(made.init)(jax.random.key(0), held, *told())


@pytest.mark.slow
def test_offspring_are_parents_varied_by_the_last_generation() -> None:
    made, held, state = begun()
    offspring, extra = compiled(made.emit)(held, state, jax.random.key(3))
    assert offspring.shape == (made.batch_size, SIZE) and extra == {}
    genotypes = told()[0]
    found = seen()
    pairs = [
        vary()(
            genotypes[own],
            row(found, other),
            preference(row(found, own), row(found, other), 0.25),
        )
        for own in range(3)
        for other in range(4)
    ]
    away = np.abs(np.asarray(pairs)[:, None] - np.asarray(offspring)).max(axis=2)
    assert (away.min(axis=0) < 1e-4).all()
    assert len({int(best) for best in away.argmin(axis=0)}) > 1


def test_parents_and_other_behaviors_are_drawn_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Parents are elites with a known behavior."""
    made, held, state = begun()
    keys, draw = [], jax.random.randint

    def randint(key: jax.Array, *arguments: Any) -> jax.Array:
        keys.append(tuple(jax.random.key_data(key).tolist()))
        return draw(key, *arguments)

    def parent(policy: Any, weights: jax.Array, *others: Any) -> jax.Array:
        del policy, others
        return weights

    monkeypatch.setattr(jax.random, "randint", randint)
    monkeypatch.setattr(ascii, "interpolated", parent)
    better = held.replace(fitnesses=held.fitnesses.at[0].add(1.0))
    made._batch_size = 40
    parents = made.emit(better, state, jax.random.key(3))[0]
    assert len(set(keys)) == len(keys) == 2
    places = [int(np.flatnonzero((held.genotypes == x).all(1))[0]) for x in parents]
    known = np.asarray(state.fitnesses) > -np.inf
    assert set(places) == set(np.flatnonzero(known)) - {0}


def test_elites_keep_their_behavior() -> None:
    """The individual whose behavior is not finite is no parent."""
    made, held, state = begun()
    genotypes, fitnesses, places, extra = told(1)
    fitnesses = fitnesses.at[0].set(-50.0)  # loses against the elite of its cell
    held = compiled(held.add)(genotypes, places, fitnesses, {})
    update = compiled(made.state_update)
    after = update(state, held, genotypes, fitnesses, places, extra)
    cells = [int(np.argmin(np.square(held.centroids - x).sum(1))) for x in places]
    np.testing.assert_array_equal(after.elites.obs[cells[0]], seen().obs[0])
    np.testing.assert_array_equal(after.elites.obs[cells[1]], seen(1).obs[1])
    np.testing.assert_array_equal(after.others.obs, seen(1).obs)
    known = np.asarray(after.fitnesses == held.fitnesses[:, 0])
    assert known[cells[:3]].all() and not known[cells[3]]


def test_better_actions_follow_the_derivative() -> None:
    own = row(seen(), slice(0, 2))
    slopes = np.random.default_rng(2).normal(size=(2, LENGTH, 2)).astype(np.float32)
    slopes[0, 3] *= 1e20
    slopes[1, 5:] = 0  # after the end
    improve = compiled(improved)
    found = np.asarray(improve(own, slopes, 0.05)) - own.actions
    lengths = np.linalg.norm(found, axis=-1)
    assert lengths.max() <= 0.05 * (1 + 1e-3) and lengths[0, 3] > 0.049
    cosine = np.sum(found * slopes / np.abs(slopes).max((1, 2), keepdims=True), -1)
    assert (cosine >= 0).all() and np.isfinite(found).all()
    np.testing.assert_array_equal(found[1, 5:], 0)
    np.testing.assert_array_equal(np.abs(improve(own, slopes, 50.0)[0, 3]), [1, 1])
    nothing = jnp.zeros((2, LENGTH, 2))
    np.testing.assert_array_equal(improve(own, nothing, 0.05), own.actions)


def rollout(weights: jax.Array, key: jax.Array) -> dict[str, jax.Array]:
    """Transitions of policies that see the same observations."""
    del key
    obs = jnp.asarray(steps()["obs"][:1, :LENGTH])
    actions = jax.vmap(jax.vmap(policy, (None, 0)), (0, None))(weights, obs[0])
    zeros = jnp.zeros(actions.shape[:2])
    shown = jnp.broadcast_to(obs, (len(weights), *obs.shape[1:]))
    return {"obs": shown, "actions": actions, "rewards": zeros, "dones": zeros}


@dataclasses.dataclass
class Found:
    """Gradients of episodes (N, 1, T, nu), and whether they were lost (N, 1), (N,)."""

    gradients: jax.Array
    overflowed: jax.Array
    faulty: jax.Array


@pytest.mark.parametrize("samples", [None, 20])
def test_exact_offspring_raise_the_return(samples: int | None) -> None:
    """The return is the sum of first actions, so its derivative is known."""
    genotypes, fitnesses, places, _ = told()
    # a second action of exactly 0: Adam makes full steps of rounding errors
    genotypes = np.array(genotypes)
    genotypes[:, 1::2] = 0
    cells = compute_euclidean_centroids((2, 2), [0.0, 0.0], [1.0, 1.0])
    archive = compiled(MapElitesRepertoire.init)
    held = archive(genotypes, fitnesses, places, cells, {})

    def gradient(actions: jax.Array, key: jax.Array) -> Any:
        del key
        slopes = jnp.zeros_like(actions).at[..., 0].set(1)
        kept = jnp.zeros((len(actions), 1), bool)
        return Found(slopes[:, None], kept, kept[:, 0])

    made = ExactAsciiEmitter(
        policy,
        rollout,
        gradient,
        SETTINGS,
        parents=3,
        branches=2,
        rates=(0.01, 0.03),
        samples=samples,
    )
    offspring, extra = compiled(made.emit)(held, None, jax.random.key(0))
    assert offspring.shape == (made.batch_size, SIZE) == (6, SIZE)
    np.testing.assert_array_equal(extra["overflowed"], False)
    parents = np.asarray(genotypes)
    gaps = np.abs(np.asarray(offspring)[:, None] - parents).max(axis=2)
    before = rollout(jnp.asarray(parents[gaps.argmin(axis=1)]), jax.random.key(0))
    after = rollout(offspring, jax.random.key(0))
    gain = np.asarray(after["actions"] - before["actions"]).sum(axis=1)
    # a part of the episode may lose where offspring do not look
    raised = gain[:, 0] if samples is None else gain[:, :1].mean(axis=0)
    assert (raised > 1e-3).all()
    # weights of the second action have no part in the return
    np.testing.assert_array_equal(gain[:, 1], 0)


def test_rates_are_log_uniform(monkeypatch: pytest.MonkeyPatch) -> None:
    def step(
        policy: Any, weights: Any, aim: Any, counts: Any, rate: Any, *_: Any
    ) -> Any:
        del policy, aim, counts
        return weights.at[0].set(rate)

    def gradient(actions: jax.Array, key: jax.Array) -> Any:
        del key
        kept = jnp.zeros((len(actions), 1), bool)
        return Found(jnp.ones_like(actions)[:, None], kept, kept[:, 0])

    monkeypatch.setattr(ascii, "interpolated", step)
    made = ExactAsciiEmitter(
        policy,
        rollout,
        gradient,
        SETTINGS,
        parents=2,
        branches=200,
        rates=(1e-3, 1.0),
    )
    rates = compiled(made.emit)(begun()[1], None, jax.random.key(0))[0][:, 0]
    tens = np.log10(rates)
    assert -3.01 < tens.min() < -2.9 and -0.1 < tens.max() <= 0
    assert abs(np.median(tens) + 1.5) < 0.3


@pytest.mark.parametrize("why", ["overflowed", "faulty", "zero"])
def test_parents_without_a_derivative_stay(why: str) -> None:
    """Every second parent has no slopes; Adam would make steps of rounding errors."""
    lost = jnp.array([[True], [False]] * 3)

    def gradient(actions: jax.Array, key: jax.Array) -> Any:
        del key
        slopes = jnp.where(lost[..., None], 0, jnp.ones_like(actions))
        return Found(
            slopes[:, None],
            lost & (why == "overflowed"),
            lost[:, 0] & (why == "faulty"),
        )

    made = ExactAsciiEmitter(
        policy,
        rollout,
        gradient,
        SETTINGS,
        parents=6,
        branches=2,
        rates=(0.01, 0.03),
    )
    genotypes, fitnesses, places, _ = told()
    cells = compute_euclidean_centroids((2, 2), [0.0, 0.0], [1.0, 1.0])
    held = MapElitesRepertoire.init(genotypes, fitnesses, places, cells, {})
    offspring, extra = compiled(made.emit)(held, None, jax.random.key(0))
    counted = lost[:, 0] & (why != "zero")
    np.testing.assert_array_equal(extra["overflowed"], counted)
    same = (offspring[:, None] == genotypes).all(axis=2).any(axis=1).reshape(6, 2)
    np.testing.assert_array_equal(same, np.tile(lost, 2))


@pytest.mark.parametrize(
    ("made", "error"),
    [
        (lambda: Interpolation(epochs=0), "epochs: got 0; allowed: .* from 1"),
        (lambda: Interpolation(deviation=0.0), "deviation: got 0.0; .* above 0"),
        (lambda: Interpolation(clip=2.0), "clip: got 2.0; allowed: .* from 0 to 1"),
        (lambda: Interpolation(similarity=-1.0), "similarity: got -1.0; allowed"),
        (lambda: ascii_emitter(batch_size=0), "batch_size: got 0; allowed"),
        (lambda: ascii_emitter(rate=0.0), "rate: got 0.0; allowed: .* above 0"),
        (lambda: exact_emitter(branches=0), "branches: got 0; allowed: .* from 1"),
        (lambda: exact_emitter(samples=0), "samples: got 0; allowed: .* from 1"),
        (lambda: exact_emitter(reach=0.0), "reach: got 0.0; allowed: .* above 0"),
        (lambda: exact_emitter(rates=(2.0, 1.0)), r"rates: got \(2.0, 1.0\); allowed"),
    ],
)
def test_bad_numbers_are_refused(made: Any, error: str) -> None:
    with pytest.raises(ValueError, match=error):
        made()


def ascii_emitter(**changes: Any) -> AsciiEmitter:
    given: Any = {"batch_size": 1, "episode_length": LENGTH, **changes}
    return AsciiEmitter(policy, SETTINGS, **given)


def exact_emitter(**changes: Any) -> ExactAsciiEmitter:
    given: Any = {"parents": 1, "branches": 1, **changes}
    nothing: Any = jnp.zeros_like
    return ExactAsciiEmitter(policy, nothing, nothing, SETTINGS, **given)


def test_transitions_are_needed() -> None:
    made, held, state = begun()
    genotypes, fitnesses, places, _ = told()
    with pytest.raises(ValueError, match=r"extra scores: got .* returns transitions"):
        made.state_update(state, held, genotypes, fitnesses, places, {})
