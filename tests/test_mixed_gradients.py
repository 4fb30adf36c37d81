"""First- and zeroth-order gradients of a smoothed episode, weighted."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from newton_qd.envs.state import State
from newton_qd.extractors import get_final_xy_position
from newton_qd.gradients import Episode, MixedGradients, make_mixed_gradient
from newton_qd.gradients.mixed import mixture
from newton_qd.qd.algorithms.gradient_options import MixedOptions


class Landscape:
    """One step; the reward is a function of the action, the descriptor is 0."""

    observation_size, action_size = 1, 3

    def __init__(self, reward: Callable[[jax.Array], jax.Array]) -> None:
        self.reward = reward

    def reset(self, rng: jax.Array) -> State:
        del rng
        return self._state(jnp.zeros((), jnp.float32))

    def step(self, state: State, action: jax.Array) -> State:
        del state
        return self._state(self.reward(action))

    def _state(self, reward: jax.Array) -> State:
        no = jnp.zeros((), jnp.float32)
        info = {
            "fault": jnp.isnan(reward).astype(jnp.int32),
            "state_descriptor": jnp.zeros((1,), jnp.float32),
        }
        return State((), jnp.zeros((1,), jnp.float32), reward, no, {}, info)


def estimate(
    reward: Callable[[jax.Array], jax.Array], actions: Any, **options: Any
) -> MixedGradients:
    run = make_mixed_gradient(
        Landscape(reward), None, get_final_xy_position, episode_length=1, **options
    )
    return jax.jit(run)(jnp.asarray(actions, jnp.float32), jax.random.key(0))


WEIGHTS = jnp.array([1.0, -2.0, 0.5], jnp.float32)


def test_first_order_where_it_has_no_variance() -> None:
    result = estimate(lambda a: a @ WEIGHTS, np.zeros((4, 1, 3)), sigma=0.1)
    np.testing.assert_allclose(
        result.gradients[:, 0, 0], np.tile(WEIGHTS, (4, 1)), 1e-5
    )
    np.testing.assert_array_equal(result.order, 1)
    np.testing.assert_allclose(result.first_variance[:, 0], 0, atol=1e-10)
    assert (result.zeroth_variance[:, 0] > 1).all()
    # what the scatter of 16 pairs explains is no bias
    assert (result.bias[:, 0] < 2.0).all()
    assert not result.faulty.any() and not result.overflowed.any()


def test_zeroth_order_where_the_first_is_noise() -> None:
    """A slope of 1 under ripples of 2 mm, whose own slope is 100."""

    def reward(action: jax.Array) -> jax.Array:
        return action[0] + 0.2 * jnp.sin(500 * action[0])

    result = estimate(reward, np.zeros((1, 1, 3)), sigma=1.0, samples=2000)
    assert result.order[0, 0] < 0.01
    np.testing.assert_allclose(result.gradients[0, 0, 0], [1, 0, 0], atol=0.15)
    ratio = result.zeroth_variance / (result.first_variance + result.zeroth_variance)
    np.testing.assert_allclose(result.order[0, 0], ratio[0, 0], 1e-5)


def test_gradients_have_the_form_of_genotypes() -> None:
    """Also of a leaf without numbers, in a small type, and with strict promotion."""
    env: Any = Landscape(lambda action: action.sum().astype(jnp.float32))
    episode = Episode(env, lambda w, seen: w["w"] + seen, episode_length=1)
    genotypes = {"w": jnp.zeros((2, 3), jnp.bfloat16), "none": jnp.zeros((2, 0))}
    key = jax.random.key(0)
    found = episode.mixed(genotypes, key, samples=2).gradients
    for name, leaf in genotypes.items():
        assert found[name].dtype == leaf.dtype
        assert found[name].shape == (2, 1, *leaf.shape[1:])
    with jax.numpy_dtype_promotion("strict"):
        strict = Episode(env, None, episode_length=1)
        assert strict.mixed(jnp.zeros((2, 1, 3)), key, samples=2).gradients.all()
    with pytest.raises(TypeError, match="genotypes: got an array of int32; allowed"):
        episode.mixed({"w": jnp.zeros((2, 3), int)}, key)


def test_noise_of_a_search_follows_from_the_genotype() -> None:
    """Neither a place in the batch nor a key that stays the same repeats it."""
    env: Any = Landscape(lambda action: jnp.sin(2 * np.pi * action).sum())
    episode, key = Episode(env, None, episode_length=1), jax.random.key(0)
    of_search = MixedOptions(samples=4, noise=0.5).gradient(episode)
    places = jnp.arange(3, dtype=jnp.float32)[:, None, None] * jnp.ones((1, 1, 3))
    found = np.asarray(of_search(places, key).gradients[:, 0])
    turned = np.asarray(of_search(places[::-1], key).gradients[:, 0])
    np.testing.assert_array_equal(found, turned[::-1])
    # one period further, only the noise is another one
    assert np.abs(found - np.roll(found, 1, axis=0)).max(axis=(1, 2)).min() > 0.1
    # the order of the numbers of a genotype counts too
    mixed = jnp.array([[[0.0, 1.0, 2.0]], [[2.0, 0.0, 1.0]], [[1.0, 2.0, 0.0]]])
    orders = np.asarray(of_search(mixed, key).gradients[:, 0])
    assert np.abs(orders - np.roll(orders, 1, axis=0)).max(axis=(1, 2)).min() > 0.1
    by_place = episode.mixed(places, key, samples=4, sigma=0.5).gradients[:, 0]
    assert np.abs(by_place - found).max() > 0.1


class Scaled(Landscape):
    """A landscape that parameters multiply."""

    def step(self, state: State, action: jax.Array, params: Any = 1.0) -> State:
        del state
        return self._state(self.reward(action) * params)


def test_samples_and_centre_have_the_parameters() -> None:
    env: Any = Scaled(lambda a: 1.0 + a @ WEIGHTS)
    episode, scale = Episode(env, episode_length=1), jnp.float32(3)
    found = episode.mixed(jnp.zeros((1, 1, 3)), jax.random.key(0), scale, samples=2)
    np.testing.assert_allclose(found.fitnesses, [3.0])
    np.testing.assert_allclose(found.gradients[0, 0, 0], 3 * WEIGHTS, rtol=1e-5)


def test_orders_are_weighted_by_their_formulas() -> None:
    """Row 0 has both orders, row 1 only the zeroth, row 2 only the first."""
    rng, sigma, pairs = np.random.default_rng(0), 0.5, 6
    shapes = ((pairs, 2, 3), (pairs, 2, 3, 4), (pairs, 4))
    values, slopes, noise = (rng.normal(size=x).astype(np.float32) for x in shapes)
    # one pair more, which does not count; and a row of values that is not finite
    given: list[Any] = [
        *(np.concatenate([x, np.full_like(x[:1], np.nan)]) for x in (values, slopes)),
        *(np.concatenate([noise, noise[:1]]), np.arange(pairs + 1) < pairs),
    ]
    given[0][3, 0, 2] = np.inf
    given += [np.array([False, True, False])]  # whose first order is lost
    weighted = jax.jit(lambda most: mixture(*given, sigma=sigma, tolerance=most))

    slope = (values[:, 0] - values[:, 1]) / (2 * sigma**2)
    samples = slopes.mean(axis=1), slope[:, :, None] * noise[:, None]
    (first, zeroth), (rough, rougher) = (
        [function(x) for x in samples]
        for function in (
            lambda x: x.mean(axis=0),
            lambda x: x.var(axis=0, ddof=1).sum(axis=1),
        )
    )
    apart = np.linalg.norm(first[0] - zeroth[0])
    explained = (samples[0] - samples[1])[:, 0].var(axis=0, ddof=1).sum() / pairs
    for tolerance in (1.0, 3.0, math.inf):
        found = weighted(tolerance)
        bound = max(tolerance - np.sqrt(rougher[0] / pairs), 0) / apart
        order = min(rougher[0] / (rough[0] + rougher[0]), bound)
        np.testing.assert_allclose(found.order, [order, 0, 1], rtol=1e-5)
        both = order * first[0] + (1 - order) * zeroth[0]
        expected = [both, zeroth[1], first[2]]
        np.testing.assert_allclose(found.gradients, expected, rtol=1e-4, atol=1e-6)
    biases = [np.sqrt(max(apart**2 - explained, 0)), np.linalg.norm(zeroth[1])]
    np.testing.assert_allclose(found.bias[:2], biases, rtol=1e-4)
    np.testing.assert_allclose(found.first_variance, [rough[0], np.inf, rough[2]], 1e-5)
    np.testing.assert_allclose(found.zeroth_variance, [*rougher[:2], np.inf], 1e-5)


def test_tolerance_finds_a_jump() -> None:
    """A step: its first order is 0 without any variance, and wrong."""

    def reward(action: jax.Array) -> jax.Array:
        return jnp.where(action[0] > 0, 1.0, 0.0).astype(jnp.float32)

    at = functools.partial(estimate, reward, np.zeros((1, 1, 3)), samples=4000)
    trusting = at(sigma=0.5)
    assert trusting.order[0, 0] == 1 and not trusting.gradients.any()
    # the slope of a step under normal noise: its density at 0
    slope = 1 / (0.5 * math.sqrt(2 * math.pi))
    np.testing.assert_allclose(trusting.bias[0, 0], slope, rtol=0.1)
    careful = at(sigma=0.5, tolerance=0.05)
    assert careful.order[0, 0] < 0.1
    np.testing.assert_allclose(careful.gradients[0, 0, 0, 0], slope, rtol=0.1)


def test_noise_does_not_repeat_the_reset(monkeypatch: pytest.MonkeyPatch) -> None:
    def key_of_noise(*arguments: Any, **options: Any) -> jax.Array:
        del options
        return jax.random.key_data(arguments[3])

    monkeypatch.setattr("newton_qd.gradients.episode.mixed_gradients", key_of_noise)
    env: Any = Landscape(jnp.sum)
    key = jax.random.key(3)
    found = Episode(env, None, episode_length=1).mixed(jnp.zeros((1, 1, 3)), key)
    assert not np.array_equal(np.asarray(found), jax.random.key_data(key))


def test_samples_that_are_not_finite_are_left_out() -> None:
    """Faulty samples; slopes beyond the numbers; an individual that is faulty."""

    def reward(action: jax.Array) -> jax.Array:
        wrong = (action[1] > 0.1) | (action[1] == -1.0)
        bad = jnp.where(wrong, jnp.nan, 0.0).astype(jnp.float32)
        steep = action[2] > 0.5
        # forward 0; backward infinity times 0
        cliff = jnp.sqrt(jnp.where(steep, 0 * action[2], 1))
        return action[0] + bad + jnp.where(steep, cliff, 0)

    actions = np.array([[[0, 0, 0]], [[0, 1, 0]], [[0, 0, 0.5]], [[0, -1, 0]]])
    result = estimate(reward, actions, sigma=0.1, samples=64)
    np.testing.assert_array_equal(result.faulty, [False, True, False, True])
    assert all(np.isfinite(x).all() for x in (result.gradients, result.order))
    np.testing.assert_allclose(result.gradients[0, 0, 0, 0], 1.0, 1e-4)
    for fault in (1, 3):  # the last has samples without a fault
        assert not result.gradients[fault].any()
        assert result.fitnesses[fault] == -np.inf
    assert not result.overflowed.any()
    # the third's first order has samples that are not finite: the zeroth alone
    assert result.order[2, 0] == 0 and np.isinf(result.first_variance[2, 0])
    np.testing.assert_allclose(result.gradients[2, 0, 0, 0], 1.0, atol=0.6)


def test_slopes_of_pairs_that_do_not_count_may_be_lost() -> None:
    """Ahead is a fault, behind the slope is not finite: only slopes of 1 are left."""

    def reward(action: jax.Array) -> jax.Array:
        x = action[0]
        behind = jnp.where(x < -0.1, jnp.sqrt(jnp.where(x < -0.1, 0 * x, 1)), 0)
        return x + behind + jnp.where(x > 0.1, jnp.nan, 0)

    result = estimate(reward, np.zeros((1, 1, 3)), sigma=0.1, samples=64)
    assert not result.overflowed.any() and np.isfinite(result.first_variance).all()
    np.testing.assert_allclose(result.gradients[0, 0, 0, 0], 1.0, rtol=1e-5)


def test_one_sound_pair_is_too_few() -> None:
    """A pair is sound with probability 0.68, so that two are with 0.47."""

    def reward(action: jax.Array) -> jax.Array:
        return jnp.where(action[0] > 1.0, jnp.nan, jnp.sum(action))

    found = estimate(reward, np.zeros((64, 1, 3)), sigma=1.0, samples=2)
    lost = np.asarray(found.overflowed[:, 0])
    assert 0.35 < lost.mean() < 0.7
    assert not found.gradients[lost, 0].any()


def test_slopes_near_the_largest_number() -> None:
    """Their sums are no numbers, and neither are reciprocals."""
    steep = 2e38
    found = estimate(lambda a: a[0] * steep, np.zeros((1, 1, 3)), samples=2)
    np.testing.assert_allclose(found.gradients[0, 0, 0], [steep, 0, 0], rtol=1e-6)


def test_slopes_whose_squares_are_no_numbers() -> None:
    """Squares above 1e38 are infinite in float32: the zeroth order takes over."""

    def reward(action: jax.Array) -> jax.Array:
        # a slope of 1 under ripples whose own slope is 1e25
        return action[0] + 1e-3 * jnp.sin(1e28 * action[1])

    result = estimate(reward, np.zeros((1, 1, 3)), sigma=0.1, samples=512)
    assert np.isfinite(result.gradients).all() and not result.overflowed.any()
    assert np.isinf(result.first_variance[0, 0]) and result.order[0, 0] < 1e-6
    # of a slope under noise, in three directions: 3 + 1, and what the ripples add
    assert 3.0 < result.zeroth_variance[0, 0] < 5.0
    np.testing.assert_allclose(result.gradients[0, 0, 0, 0], 1.0, atol=0.3)


@pytest.mark.parametrize("sigma", [1e-30, 1e-38])
def test_noise_whose_square_is_no_number(sigma: float) -> None:
    result = estimate(lambda a: a @ WEIGHTS, np.zeros((1, 1, 3)), sigma=sigma)
    np.testing.assert_allclose(result.gradients[0, 0, 0], WEIGHTS, rtol=1e-5)
    assert np.isfinite(result.order).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("samples", 1),
        ("samples", 2.0),
        ("sigma", 0.0),
        ("sigma", math.inf),
        ("tolerance", -1.0),
        ("tolerance", 0.0),
        ("tolerance", math.nan),
    ],
)
def test_bad_settings(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{name}: got {value}; allowed"):
        estimate(lambda a: a[0], np.zeros((1, 1, 3)), **{name: value})
