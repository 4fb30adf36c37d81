"""Values that constructors, ``create`` and wrappers refuse, by name and value."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import newton_qd
from newton_qd.wrappers import MazeWrapper, TrapWrapper, VectorWrapper

NUMBER, RANGE = "allowed: finite numbers", "allowed: two numbers, lowest below highest"


@pytest.mark.parametrize(
    ("name", "option", "value", "error", "allowed"),
    [
        ("hopper", "reset_noise_scale", float("nan"), ValueError, NUMBER),
        ("hopper", "reset_noise_scale", -1.0, ValueError, "finite numbers from 0"),
        ("reacher", "reset_velocity_noise_scale", -1.0, ValueError, "numbers from 0"),
        ("ant", "healthy_z_range", (1.0, 0.2), ValueError, RANGE),
        ("humanoid_w_trap", "healthy_z_range", (1.0, 0.2), ValueError, RANGE),
        ("walker2d", "healthy_angle_range", (1.0, -1.0), ValueError, RANGE),
        ("ant_uni", "healthy_z_range", 0.2, TypeError, RANGE),
        ("ant_uni", "healthy_z_range", (0.2, 1, 2), TypeError, RANGE),
        ("humanoid", "healthy_z_range", ("low", 1), TypeError, RANGE),
        ("hopper_uni", "ctrl_cost_weight", float("nan"), ValueError, NUMBER),
        ("ant_uni", "ctrl_cost_weight", "1.", TypeError, NUMBER),
        ("swimmer", "ctrl_cost_weight", None, TypeError, NUMBER),
        ("ant", "use_contact_forces", "no", TypeError, "allowed: True, False"),
        ("ant", "dtype", "foo", ValueError, "allowed: float32, float64"),
        ("pointmaze", "dtype", "float16", ValueError, "allowed: float32, float64"),
        ("pointmaze", "auto_reset", "no", TypeError, "allowed: True, False"),
        ("pointmaze", "fixed_init_state", "no", TypeError, "allowed: True, False"),
        ("ant", "material", "soft", TypeError, "allowed: None, or newton_qd.robots.M"),
        ("ant_uni", "qdax_wrappers_kwargs", {"width": 1}, TypeError, "sequence of"),
        ("ant_uni", "qdax_wrappers_kwargs", [None], TypeError, "sequence of dict"),
    ],
)
def test_bad_options_are_named(
    name: str, option: str, value: Any, error: type[Exception], allowed: str
) -> None:
    with pytest.raises(error, match=f"^{option}: got .*{allowed}"):
        newton_qd.create(name, **{option: value})


def test_ranges_may_be_lists_and_numbers_of_numpy() -> None:
    options = {"healthy_z_range": [0.2, np.float32(1)], "healthy_reward": np.float64(2)}
    env = newton_qd.create("ant", **options)  # pyright: ignore[reportArgumentType]
    first = jax.jit(lambda key: env.step(env.reset(key), jnp.zeros(8)))
    state = first(jax.random.key(0))
    assert state.metrics["reward_survive"] == 2 and state.done == 0


def test_counts_may_be_of_numpy() -> None:
    counts: Any = {"episode_length": np.int64(10), "batch_size": np.int64(3)}
    env: Any = newton_qd.create("pointmaze", **counts)
    assert env.episode_length == 10 and env.batch_size == 3


def test_a_robot_stands_in_one_scene() -> None:
    trap, maze = (newton_qd.create(name) for name in ("anttrap", "antmaze"))
    for wrapper, env, scene in (
        (MazeWrapper, trap, "trap"),
        (TrapWrapper, trap, "trap"),
        (TrapWrapper, maze, "maze"),
    ):
        with pytest.raises(
            ValueError, match=f"env: got ant in the scene '{scene}'; allowed"
        ):
            wrapper(env, "ant")


def test_batched_actions_are_named_as_they_were_given() -> None:
    env = newton_qd.create("pointmaze", batch_size=3)
    state = env.reset(jax.random.key(0))
    with pytest.raises(
        ValueError, match=r"action: got .*\(3, 7\).*allowed: .*\(3, 2\)"
    ):
        env.step(state, jnp.zeros((3, 7)))
    with pytest.raises(TypeError, match=r"action: got \[\[0.0.*allowed: .*\(3, 2\)"):
        env.step(state, [[0.0] * 2] * 3)  # pyright: ignore[reportArgumentType]


def test_batches_of_batches_are_refused() -> None:
    env = newton_qd.create("pointmaze", episode_length=None, auto_reset=False)
    with pytest.raises(ValueError, match="env: got 2 worlds; allowed"):
        VectorWrapper(VectorWrapper(env, 2), 3)
