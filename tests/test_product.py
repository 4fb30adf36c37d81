"""Every combination of the options of ``create``, for every registered name."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contract import EVERY_NAME, NAMES, outline, zero_action

import newton_qd
from newton_qd import tasks
from newton_qd.envs.state import State

OPTIONS: dict[str, tuple[Any, ...]] = {
    "fixed_init_state": (False, True),
    "batch_size": (None, 2),
    "action_repeat": (1, 2),
    "auto_reset": (True, False),
    "episode_length": (None, 3),
    "eval_metrics": (False, True),
}
PRODUCT = [
    dict(zip(OPTIONS, values, strict=True))
    for values in itertools.product(*OPTIONS.values())
]
KEY = jax.random.key(0)
OTHERS = [
    pytest.param(name, marks=pytest.mark.slow)
    for name in newton_qd.registered_envs()
    if name not in NAMES
]


def allowed(options: dict[str, Any]) -> bool:
    """Whether ``create`` takes a combination: sums and repeats need an episode."""
    if options["episode_length"] is not None:
        return True
    return options["action_repeat"] == 1 and not options["eval_metrics"]


def traced_once(env: Any) -> Any:
    """JAX traces its methods once, whatever wraps it; so for what it is turned into."""
    kind = type(env)
    for change in ("with_scene", "with_feet_width"):
        if hasattr(kind, change):
            make = functools.partial(getattr(kind, change), env)
            changed = functools.cache(lambda *x, make=make: traced_once(make(*x)))
            vars(env)[change] = changed
    for method in ("reset", "step"):
        vars(env)[method] = jax.jit(functools.partial(getattr(kind, method), env))
    return env


@pytest.fixture
def shared_base(monkeypatch: pytest.MonkeyPatch, request: Any) -> str:
    """The environment inside is made and traced once a name: that is the slow part."""
    name = request.param
    row = tasks.ENVIRONMENTS[name]
    base = traced_once(row.base())
    shared = dataclasses.replace(row, base=lambda: base)
    monkeypatch.setitem(tasks.ENVIRONMENTS, name, shared)
    return name


@pytest.mark.parametrize("shared_base", [*EVERY_NAME, *OTHERS], indirect=True)
def test_shapes(shared_base: str) -> None:
    for options in PRODUCT:
        if not allowed(options):
            with pytest.raises(ValueError, match="episode_length: got None with"):
                newton_qd.create(shared_base, **options)
            continue
        env = newton_qd.create(shared_base, **options)
        first = jax.eval_shape(env.reset, KEY)
        second = jax.eval_shape(env.step, first, zero_action(env, first))
        assert jax.tree.structure(first) == jax.tree.structure(second), options
        assert outline(first) == outline(second), options
        lead = () if options["batch_size"] is None else (2,)
        assert first.obs.shape == (*lead, env.observation_size), options
        assert all(x.shape[: len(lead)] == lead for x in jax.tree.leaves(first))
        assert_keys(first, options)


def assert_keys(state: State, options: dict[str, Any]) -> None:
    expected = {
        "steps": options["episode_length"] is not None,
        "truncation": options["episode_length"] is not None,
        "first_obs": options["auto_reset"],
        "first_pipeline_state": options["auto_reset"],
        "eval_metrics": options["eval_metrics"],
        "completed_eval_metrics": options["eval_metrics"],
    }
    assert {key: key in state.info for key in expected} == expected, options


@pytest.mark.parametrize("options", [o for o in PRODUCT if allowed(o)], ids=str)
def test_values(options: dict[str, Any]) -> None:
    """Four actions on the maze: positions and counts, whatever the wrappers."""
    env: Any = newton_qd.create("pointmaze", **options)
    state = first = env.reset(KEY)
    other = env.reset(jax.random.key(1))
    assert np.array_equal(first.obs, other.obs) == options["fixed_init_state"]
    step = jax.jit(env.step)
    action = jnp.broadcast_to(jnp.array([0.1, 0.2], np.float32), first.obs.shape)
    repeat, length = options["action_repeat"], options["episode_length"]
    moved, steps, ended, total = 0, 0, 0, 0.0
    for _ in range(4):
        state = step(state, action)
        if length is not None and steps >= length and options["auto_reset"]:
            steps = 0
        moved, steps = moved + repeat, steps + repeat
        done = length is not None and steps >= length
        assert np.all(state.done == done)
        if length is not None:
            assert np.all(state.info["steps"] == steps)
            assert np.all(state.info["truncation"] == done)
        if options["eval_metrics"]:
            total = total + np.asarray(state.reward)
        ended += done
        moved = 0 if done and options["auto_reset"] else moved
        expected = np.asarray(first.obs) + moved * np.array([0.01, 0.02])
        np.testing.assert_allclose(state.obs, expected, atol=1e-6)
        assert np.array_equal(state.info["state_descriptor"], state.obs)
    if options["eval_metrics"] and options["auto_reset"]:
        sums = state.info["completed_eval_metrics"]
        assert np.all(sums.completed_episodes == ended)
        both = (
            sums.completed_episodes_metrics["reward"]
            + sums.current_episode_metrics["reward"]
        )
        np.testing.assert_allclose(both, total, rtol=1e-5)
