"""The object that runs an episode: its methods, its identity, what it refuses."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import pickle
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contract import same
from test_episode_gradients import Line, feedback, feedback_weights, make

from newton_qd import gradients
from newton_qd.extractors import get_feet_contact_proportion, get_final_xy_position
from newton_qd.gradients import (
    Episode,
    GradientOptions,
    make_directional_gradient,
    make_episode,
    make_episode_gradient,
    make_mixed_gradient,
)

STEPS, KEY = 8, jax.random.key(3)
OPTIONS = GradientOptions(window=3, clip=2.0, discount=0.9, checkpoint_every=4)


def equal(found: Any, expected: Any) -> bool:
    """Whether two results have the same bits, once both are compiled."""
    return same(jax.jit(found)(), jax.jit(expected)())


@pytest.fixture(scope="module")
def hopper() -> tuple[Any, Any]:
    """What episodes of a hopper are made of, and weights of its policy."""
    env = make("hopper_uni", "float32")
    return (env, feedback, get_feet_contact_proportion), feedback_weights(env, 3)


@pytest.fixture(scope="module")
def line() -> tuple[Episode, jax.Array]:
    """Actions on a line, and plans of them."""
    episode = Episode(Line(1.1), None, get_final_xy_position, episode_length=STEPS)
    return episode, 0.1 * jnp.ones((3, STEPS, 1), jnp.float32)


@pytest.mark.slow
@pytest.mark.parametrize("options", [None, OPTIONS])
def test_methods_are_the_functions_that_were(hopper: Any, options: Any) -> None:
    """Bitwise, with default options and others."""
    parts, weights = hopper
    settings = {} if options is None else {"options": options}
    episode = Episode(*parts, episode_length=STEPS, **settings)
    old = {"episode_length": STEPS, "options": options}
    plain = jax.vmap(make_episode(*parts, **old), (0, None))
    assert equal(
        lambda: jax.vmap(episode, (0, None))(weights, KEY), lambda: plain(weights, KEY)
    )
    gradient = make_episode_gradient(*parts, **old)
    found = jax.jit(episode.gradient)(weights, KEY)
    assert same(found, jax.jit(gradient)(weights, KEY))
    assert any(np.any(x) for x in jax.tree.leaves(found.gradients))
    ways = jnp.array([[[1.0, 0.5]]] * 3, jnp.float32)
    along = make_directional_gradient(*parts, **old)
    assert equal(
        lambda: episode.directional(weights, ways, KEY),
        lambda: along(weights, ways, KEY),
    )


@pytest.mark.parametrize(
    ("shape", "text"),
    [
        ((2, 1, 2), "got shape (2, 1, 2); allowed: shape (3, R, 1 + D), R from 1"),
        ((3, 2), "got shape (3, 2); allowed: shape (3, R, 1 + D), R from 1"),
        ((3, 0, 2), "got shape (3, 0, 2); allowed: shape (3, R, 1 + D), R from 1"),
        ((3, 1, 5), "weights: got 5 columns; allowed: 1 + D = 2"),
    ],
)
def test_weights_of_a_wrong_shape(shape: Any, text: str, hopper: Any) -> None:
    parts, weights = hopper
    episode = Episode(*parts, episode_length=STEPS)
    with pytest.raises(ValueError, match=re.escape(text)):
        jax.eval_shape(episode.directional, weights, jnp.ones(shape), KEY)


def test_weights_are_an_array(line: Any) -> None:
    episode, plans = line
    nested: Any = [[[1.0, 0.0]]] * len(plans)
    with pytest.raises(TypeError, match="weights: got a list; allowed: an array of"):
        episode.directional(plans, nested, KEY)


def test_a_gradient_is_a_function_and_noise_needs_a_key(line: Any) -> None:
    episode, plans = line
    wrong: Any = 3
    with pytest.raises(TypeError, match="gradient: got 3; allowed: a method that ret"):
        episode.scoring(wrong)
    with pytest.raises(TypeError, match=r"^key: got "):
        episode.mixed(plans, wrong)


def test_descriptors_of_a_wrong_shape(line: Any) -> None:
    """A descriptor (D,) would lose all components but the first."""
    episode, plans = line
    flat = dataclasses.replace(
        episode, descriptor_extractor=lambda data, mask: data.state_desc[0, -1]
    )
    with pytest.raises(ValueError, match=r"got descriptors of shape \(1,\); allowed"):
        flat(plans[0], KEY)


def test_integers_have_no_gradient(line: Any) -> None:
    episode, plans = line
    with pytest.raises(TypeError, match="genotypes: got an array of int32; allowed: a"):
        episode.gradient(plans.astype(jnp.int32), KEY)


def test_mixed_gradients_are_the_function_that_was(line: Any) -> None:
    episode, plans = line
    settings: Any = {"samples": 4, "sigma": 0.1, "tolerance": 0.5}
    old = make_mixed_gradient(
        Line(1.1), None, get_final_xy_position, episode_length=STEPS, **settings
    )
    assert equal(lambda: episode.mixed(plans, KEY, **settings), lambda: old(plans, KEY))


@pytest.mark.slow
def test_gradients_begin_from_a_state_with_parameters(hopper: Any) -> None:
    parts, weights = hopper
    env, episode = parts[0], Episode(*parts, episode_length=STEPS)
    run = jax.jit(episode.gradient)
    start = jax.jit(env.reset)(KEY)
    expected = run(weights, KEY)
    assert same(run(weights, start), expected)
    params = env.default_params
    assert same(run(weights, KEY, params), expected)
    light = params.replace(gravity=0.5 * params.gravity)
    assert not same(run(weights, KEY, light), expected)
    ways = jnp.array([[[1.0, 0.0]]] * 3, jnp.float32)
    along = jax.jit(episode.directional)(weights, ways, KEY, light)
    values = jax.jit(episode.gradient)(weights, KEY, light)
    np.testing.assert_array_equal(along.fitnesses, values.fitnesses)


def test_scores(line: Any) -> None:
    """Without gradients; with exact ones; with mixed ones; -inf where faulty."""
    episode, plans = line
    plans = plans.at[1, 0].set(2000.0)
    fitnesses, descriptors, extra = jax.jit(episode.scoring())(plans, KEY)
    np.testing.assert_array_equal(np.isinf(fitnesses), [False, True, False])
    assert descriptors.shape == (3, 1) and extra == {}
    scored = jax.jit(episode.scoring(episode.gradient))(plans, KEY)
    np.testing.assert_array_equal(scored[0], fitnesses)
    found = jax.jit(episode.gradient)(plans, KEY)
    np.testing.assert_array_equal(
        scored[2]["gradients"], np.moveaxis(found.gradients, 1, -1)
    )
    sizes = np.linalg.norm(scored[2]["normalized_grads"], axis=(1, 2))
    np.testing.assert_allclose(sizes[:, 0], [1, 0, 1], rtol=1e-6)
    mixed = episode.scoring(functools.partial(episode.mixed, samples=2, sigma=0.1))
    assert jax.jit(mixed)(plans, KEY)[2]["gradients"].shape == (3, STEPS, 1, 2)


@pytest.mark.slow
@pytest.mark.parametrize("every", [False, True])
def test_what_is_not_jitted_is_compiled_once(every: bool) -> None:
    """The policy is traced in the first call only, also by gradients of a call."""
    traces = []

    def policy(weights: jax.Array, obs: jax.Array) -> jax.Array:
        traces.append(obs)
        return jnp.tanh(weights * obs)

    episode = Episode(Line(1.1), policy, get_final_xy_position, episode_length=STEPS)
    weights = jnp.array([[0.1], [0.2]], jnp.float32)
    around = {"params": None, "samples": 2, "sigma": 0.1}
    calls = {
        "gradient": lambda: episode.gradient(weights, KEY),
        "of a call": lambda: jax.grad(lambda w: episode(w, KEY).fitness)(weights[0]),
    }
    more = {
        "call": lambda: episode(weights[0], KEY),
        "keywords": lambda: episode.gradient(genotypes=weights, start=KEY),
        "others": lambda: episode.gradient(genotypes=2 * weights, start=KEY),
        "mixed": lambda: episode.mixed(weights, KEY, **around),
        "scores": lambda: episode.scoring()(weights, KEY),
        "of many": lambda: jax.vmap(episode, (0, None))(weights, KEY),
    }
    for name, call in (calls | more if every else calls).items():
        first = call()
        traces.clear()
        assert same(call(), first) and not traces, name
        assert not every or same(jax.jit(call)(), first), name
    assert pickle.loads(pickle.dumps(Episode(Line(1.1), episode_length=2))) is not None
    assert not hasattr(dataclasses.replace(episode, episode_length=2), "_compiled")


def test_no_fault_pays(line: Any) -> None:
    """The fitness is -inf, and has no gradient; the flag says which world it is."""
    episode, plans = line
    plans = -plans.at[1, 0].set(-2000.0)  # the others have rewards below 0

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def mean(plans: jax.Array) -> tuple[jax.Array, Any]:
        found = jax.vmap(episode, (0, None))(plans, KEY)
        sound = jnp.where(found.faulty, 0.0, found.fitness)
        return sound.sum() / (~found.faulty).sum(), found

    (value, found), slope = mean(plans)
    np.testing.assert_array_equal(found.faulty, [False, True, False])
    assert found.fitness[1] == -np.inf == found.admitted_fitness[1]
    assert np.isfinite(found.fitness[::2]).all() and value < 0
    assert not slope[1].any() and np.isfinite(slope).all() and slope[::2].all()


def test_it_is_immutable_and_its_own_key(line: Any) -> None:
    episode, plans = line
    with pytest.raises(dataclasses.FrozenInstanceError):
        episode.episode_length = 2
    other = dataclasses.replace(episode, episode_length=STEPS)
    assert episode == episode and episode != other and hash(episode) == hash(episode)
    traces = []

    @jax.jit
    def run(given: Episode, plan: jax.Array) -> jax.Array:
        traces.append(given)
        return given(plan, KEY).fitness

    assert run(episode, plans[0]) == run(episode, plans[1])
    assert traces == [episode]
    assert not jax.tree.leaves(episode)


def test_repr_says_what_it_is_made_of() -> None:
    shown = repr(Episode(Line(1.0), feedback, episode_length=4, options=OPTIONS))
    for part in ("Episode(env=", "Line", "feedback", "episode_length=4", repr(OPTIONS)):
        assert part in shown


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("env", "hopper"),
        ("policy", "feedback"),
        ("descriptor_extractor", (1,)),
        ("unravel", None),
        ("options", None),
        ("options", {"clip": 1.0}),
        ("transitions", "yes"),
    ],
)
def test_bad_types(name: str, value: Any) -> None:
    given: Any = {"env": Line(1.0), "episode_length": 4, name: value}
    with pytest.raises(TypeError, match=f"^{name}.*allowed"):
        Episode(**given)


@pytest.mark.parametrize("length", [0, 2.0, True])
def test_bad_lengths(length: Any) -> None:
    with pytest.raises(ValueError, match=r"^episode_length.*allowed"):
        Episode(Line(1.0), episode_length=length)


@pytest.mark.parametrize(
    ("name", "value"), [("samples", 1), ("sigma", 0.0), ("tolerance", -1.0)]
)
def test_bad_mixtures(line: Any, name: str, value: Any) -> None:
    episode, plans = line
    with pytest.raises(ValueError, match=f"^{name}.*allowed"):
        episode.mixed(plans, KEY, **{name: value})


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("episode", "make_episode"),
        ("exact", "make_episode_gradient"),
        ("exact", "make_directional_gradient"),
        ("mixed", "make_mixed_gradient"),
    ],
)
def test_functions_that_have_moved(module: str, name: str) -> None:
    home = importlib.import_module(f"newton_qd.gradients.{module}")
    with pytest.warns(DeprecationWarning, match=f"now newton_qd.gradients.{name}"):
        assert getattr(home, name) is getattr(gradients, name)
