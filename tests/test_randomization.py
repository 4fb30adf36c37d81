"""Parameters of environments: through wrappers, drawn at random, and refused."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contract import make, random_actions, reset, row, same, step

import newton_qd
from newton_qd import PhysicsParams, State, randomize_params
from newton_qd.wrappers import RandomParamsWrapper

KEY = jax.random.key(7)
RANGES: dict[str, Any] = {
    "gravity": (5.0, 15.0),
    "friction": (0.2, 1.2),
    "contact_stiffness_scale": (0.5, 2.0),
    "mass_scale": (0.7, 1.3),
    "inertia_scale": (0.9, 1.1),
    "damping_scale": (0.0, 2.0),
    "gear_scale": (0.8, 1.2),
}


def seen(state: State) -> Any:
    """What a world shows; without the sums over a batch."""
    info = (state.info["state_descriptor"], state.info["steps"])
    return state.pipeline_state, state.obs, state.reward, state.done, info


def test_worlds_of_a_batch_have_their_own_parameters() -> None:
    """Through every wrapper, a reset included: each as if it were alone, bitwise."""
    env = make("ant_uni", "all")
    single = newton_qd.create(
        "ant_uni", episode_length=3, action_repeat=2, fixed_init_state=True
    )
    params = randomize_params(KEY, env, **RANGES)
    start, alone = reset(env)(KEY), [reset(single)(KEY)] * 3
    state, actions = start, random_actions(env, (3, 3))
    for action in actions:
        state = step(env)(state, action, params)
        for world in range(3):
            own = row(params, world)
            alone[world] = step(single)(alone[world], action[world], own)
            assert same(seen(alone[world]), row(seen(state), world))
    assert state.info["steps"].tolist() == [2, 2, 2]
    assert len(np.unique(state.obs[:, 0])) == 3
    given = step(env)(start, actions[0], env.default_params)
    assert same(given, step(env)(start, actions[0]))


def test_draws_are_within_their_ranges() -> None:
    env = make("ant_uni")
    params = randomize_params(KEY, env, 200, **RANGES)
    default = env.default_params
    for name, (low, high) in RANGES.items():
        values = np.asarray(getattr(params, name))
        assert values.dtype == np.float32
        assert values.shape == (200, *getattr(default, name).shape)
        assert low <= values.min() < low + 0.2 * (high - low)
        assert high - 0.2 * (high - low) < values.max() <= high
    # every entry by itself
    scales = np.asarray(params.mass_scale)
    assert np.abs(np.corrcoef(scales.T) - np.eye(9)).max() < 0.4
    # and every parameter, of those with one shape
    for names in (("gravity", "friction"), ("mass_scale", "inertia_scale")):
        one, other = (np.asarray(getattr(params, n)).reshape(-1) for n in names)
        assert abs(np.corrcoef(one, other)[0, 1]) < 0.4


def test_draws_depend_on_key_and_world_alone() -> None:
    env = make("ant_uni")
    many = randomize_params(KEY, env, 9, **RANGES)
    assert same(randomize_params(KEY, env, 4, **RANGES), row(many, slice(4)))
    friction = randomize_params(KEY, env, 9, friction=RANGES["friction"])
    assert same(friction.friction, many.friction)
    assert same(row(friction, 0).gear_scale, env.default_params.gear_scale)
    other = randomize_params(jax.random.key(8), env, 9, **RANGES)
    assert not np.isin(np.asarray(other.friction), np.asarray(many.friction)).any()
    traced = jax.jit(lambda key: randomize_params(key, env, 9, **RANGES))(KEY)
    for a, b in zip(jax.tree.leaves(traced), jax.tree.leaves(many), strict=True):
        np.testing.assert_allclose(
            a, b, rtol=1e-6
        )  # XLA contracts low + u (high - low)


def test_ranges_of_arrays_and_of_one_value() -> None:
    env = make("ant_uni", "batch")
    low = np.ones(9)
    low[0] = 0.5
    params = randomize_params(KEY, env, mass_scale=(low, np.ones(9)), friction=(2, 2))
    masses = np.asarray(params.mass_scale)
    assert masses.shape == (3, 9)
    assert (masses[:, 1:] == 1.0).all() and (masses[:, 0] < 1.0).all()
    assert (np.asarray(params.friction) == 2.0).all()
    one = randomize_params(KEY, make("ant_uni"), gravity=(1.0, 2.0))
    assert one.gravity.shape == ()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"friction": (0.5,)}, r"friction: got .*\(low, high\)"),
        ({"friction": 0.5}, r"friction: got 0.5.*\(low, high\), numbers$"),
        ({"gear_scale": (np.ones(3), 2.0)}, r"gear_scale: got .*\(8,\)"),
        ({"gravity": (2.0, 1.0)}, r"gravity: got .*low is above high"),
        ({"mass_scale": (0.0, 1.0)}, r"mass_scale: got 0.0; .*above 0"),
        ({"damping_scale": (-1.0, 1.0)}, r"damping_scale: got -1.0; .*from 0"),
        ({"friction": (0.0, np.inf)}, r"friction: got inf; .*finite"),
        ({"friction": ("0", "1")}, r"friction: got \('0', '1'\); .*numbers$"),
        ({"friction": (0.5, "0.7", 0.9)}, r"friction: got .*numbers$"),
        ({"friction": {0: 1, 1: 2}}, r"friction: got \{0: 1, 1: 2\}; .*numbers$"),
        ({"worlds": 0}, "worlds: got 0; allowed: .*integers from 1"),
        ({"worlds": True}, r"worlds: got True; allowed"),
    ],
)
def test_wrong_ranges(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        randomize_params(KEY, make("ant_uni"), **options)


def test_a_wrapper_without_ranges_is_refused() -> None:
    """It would change nothing."""
    none: Any = {"gravity": None}
    for ranges in ({}, none):
        with pytest.raises(ValueError, match=r"^ranges: got \{.*; allowed: a range of"):
            RandomParamsWrapper(make("ant_uni"), **ranges)


def replaced(**changes: Any) -> PhysicsParams:
    default: Any = make("ant_uni").default_params
    return default.replace(**changes)


@pytest.mark.parametrize(
    ("params", "error", "message"),
    [
        (
            {"mass": 2.0},
            TypeError,
            r"params: got {'mass': 2.0}; allowed: None, or Phys",
        ),
        (2.0, TypeError, r"params: got 2.0"),
        (lambda: replaced(mass_scale=jnp.ones(8)), ValueError, r"mass_scale: .*\(9,\)"),
        (lambda: replaced(friction=jnp.ones(1)), ValueError, r"friction: .*\(\)"),
        (lambda: replaced(gravity=jnp.ones((), int)), TypeError, r"gravity: got .*int"),
        (lambda: replaced(gear_scale=None), TypeError, r"gear_scale: got None"),
        (lambda: replaced(friction="a"), TypeError, r"friction: got 'a'"),
        (
            lambda: replaced(mass_scale=-jnp.ones(9)),
            ValueError,
            r"mass_scale: got -1.0",
        ),
        (lambda: replaced(inertia_scale=jnp.zeros(9)), ValueError, r"above 0"),
        (lambda: replaced(friction=-0.5), ValueError, r"params.friction: got -0.5"),
        (lambda: replaced(gravity=np.float32(np.nan)), ValueError, r"gravity: got nan"),
    ],
)
def test_wrong_parameters(params: Any, error: type[Exception], message: str) -> None:
    env = make("ant_uni")
    state = reset(env)(KEY)
    given = params() if callable(params) else params
    with pytest.raises(error, match=message):
        env.step(state, jnp.zeros(8, np.float32), given)


def test_wrong_batch() -> None:
    env = make("ant_uni", "batch")
    state, action = reset(env)(KEY), jnp.zeros((3, 8), np.float32)
    one = make("ant_uni").default_params
    with pytest.raises(ValueError, match=r"params: .*shape \(\), .*batch axis \(3,\)"):
        env.step(state, action, one)
    with pytest.raises(ValueError, match=r"params: .*shape \(4,\)"):
        env.step(state, action, randomize_params(KEY, make("ant_uni"), 4))
    with pytest.raises(ValueError, match="worlds: got 4; allowed: 3, as env has, or"):
        randomize_params(KEY, env, 4)
    randomize_params(KEY, env, 3)


def test_float64_parameters_are_refused_by_float32(x64: None) -> None:
    env = make("ant_uni")
    default: Any = env.default_params
    assert default.gravity.dtype == np.float32
    wide = default.replace(damping_scale=jnp.ones(14, np.float64))
    with pytest.raises(TypeError, match=r"damping_scale: got .*float64; .*float32"):
        jax.eval_shape(env.step, reset(env)(KEY), jnp.zeros(8, np.float32), wide)


def test_weak_numbers_are_taken() -> None:
    env = make("ant_uni")
    state, action = reset(env)(KEY), random_actions(env, ())
    weak = step(env)(state, action, replaced(friction=0.25, gravity=5))
    strong = replaced(friction=jnp.asarray(0.25, np.float32), gravity=np.float32(5))
    assert same(weak, step(env)(state, action, strong))


def test_environments_without_parameters() -> None:
    env = make("pointmaze", "batch")
    state, action = reset(env)(KEY), jnp.zeros((3, 2), np.float32)
    assert env.default_params is None
    advance = jax.jit(env.step)
    assert same(
        advance(state, action, env.default_params), advance(state, action, None)
    )
    params = randomize_params(KEY, make("ant_uni"), 3)
    with pytest.raises(ValueError, match=r"params: got PhysicsParams\(.*None"):
        env.step(state, action, params)
    with pytest.raises(
        ValueError, match=r"env: got pointmaze, .* no physical parameters"
    ):
        randomize_params(KEY, env)


def test_environments_of_other_libraries_are_refused() -> None:
    env: Any = SimpleNamespace()
    env.unwrapped = env  # as those of brax and Gymnasium
    with pytest.raises(TypeError, match=r"env: got namespace\(.*; allowed: an env"):
        randomize_params(KEY, env)
