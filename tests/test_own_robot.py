"""A robot that is not part of the suite, as ``examples/own_robot.py`` makes it."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import newton_qd
from newton_qd import tasks
from newton_qd.brax_views import BraxViewsWrapper
from newton_qd.envs.locomotion import Locomotion
from newton_qd.physics.system import PhysicsState

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "own_robot.py"


@pytest.fixture(scope="module")
def example() -> Iterator[ModuleType]:
    """The example, whose names are known while this file's tests run."""
    rows = dict(tasks.ENVIRONMENTS)
    spec = importlib.util.spec_from_file_location("own_robot", EXAMPLE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    tasks.ENVIRONMENTS.clear()
    tasks.ENVIRONMENTS.update(rows)


def test_tripod_is_a_task(example: ModuleType) -> None:
    del example  # its import registers the name
    env = newton_qd.create("tripod_uni", episode_length=20, auto_reset=False)
    actions = jax.random.uniform(jax.random.key(1), (20, env.action_size), minval=-1.0)

    @jax.jit
    def rollout(key: jax.Array) -> newton_qd.State:
        def advance(state: newton_qd.State, action: jax.Array):
            state = env.step(state, action)
            return state, state

        return jax.lax.scan(advance, env.reset(key), actions)[1]

    states = rollout(jax.random.key(0))
    newton_qd.check(jax.tree.map(lambda leaf: leaf[-1], states))
    assert states.obs.shape == (20, env.observation_size) == (20, 23)
    assert states.info["state_descriptor"].shape == (20, 3)
    assert float(states.info["state_descriptor"].max()) == 1.0
    x = np.asarray(states.pipeline_state.q[:-1, 0])
    velocity = np.diff(x) / env.dt
    cost = 0.5 * np.sum(np.square(actions[1:-1]), axis=1)
    expected = velocity + 1.0 - cost
    np.testing.assert_allclose(states.reward[1:-1], expected, atol=1e-4)


def test_tripod_is_in_the_tables(example: ModuleType) -> None:
    del example  # its import registers the names
    assert newton_qd.tables.FEET_NAMES["tripod"] == ("foot_1", "foot_2", "foot_3")
    assert newton_qd.tables.COG_NAMES["tripod"] == "body"
    assert newton_qd.tables.FORWARD_REWARD_NAMES["tripod"] == "reward_forward"


def test_forward_reward_is_seen_through_partials() -> None:
    inner = functools.partial(Locomotion, healthy_reward=2.0)
    row = tasks.EnvironmentSpec(functools.partial(inner, ctrl_cost_weight=0.0), "x")
    assert row.forward_reward == "reward_forward"


def test_reward_has_a_gradient(example: ModuleType) -> None:
    env = Locomotion(example.TRIPOD)
    state = jax.jit(env.reset)(jax.random.key(0))
    slope = jax.jit(jax.grad(lambda action: env.step(state, action).reward))
    gradient = slope(jnp.zeros(env.action_size))
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() > 0


def test_bad_options(example: ModuleType) -> None:
    with pytest.raises(ValueError, match=r"healthy_z_range: got \(1.0, 0.5\).*allowed"):
        Locomotion(example.TRIPOD, healthy_z_range=(1.0, 0.5))
    with pytest.raises(FileNotFoundError, match="nowhere"):
        Locomotion(dataclasses.replace(example.TRIPOD, urdf="./nowhere.urdf"))


def test_robot_that_nothing_drives(example: ModuleType) -> None:
    passive = dataclasses.replace(example.TRIPOD, actuators=())
    with pytest.raises(
        ValueError, match=r"'tripod', actuators: got \(\), .*allowed: at l"
    ):
        Locomotion(passive)


def test_robot_that_touches_nothing_resets(example: ModuleType) -> None:
    free = dataclasses.replace(example.TRIPOD, contacts=(), feet=())
    env = Locomotion(free)
    state = jax.eval_shape(env.reset, jax.random.key(0))
    assert state.obs.shape == (env.observation_size,)
    jax.eval_shape(BraxViewsWrapper(env).sys.default_qp, jnp.zeros(6))


def test_walls_of_the_yard_stop_the_tripod(example: ModuleType) -> None:
    """Sent at the first wall it stays on this side; beside the wall it goes on."""
    env = Locomotion(example.TRIPOD, scene=example.YARD)
    start = jax.jit(env.reset)(jax.random.key(0))

    def end(y: float) -> float:
        """Forward position [m] after two seconds, thrown at 8 m/s."""
        physics = start.pipeline_state
        assert isinstance(physics, PhysicsState)
        q = physics.q.at[1].set(y)
        v = physics.v.at[0].set(8.0)
        sent = start.replace(pipeline_state=dataclasses.replace(physics, q=q, v=v))
        still = jnp.zeros((50, env.action_size))
        last = jax.lax.scan(lambda s, a: (env.step(s, a), None), sent, still)[0]
        return last.pipeline_state.q[0]

    ends = jax.jit(jax.vmap(end))(jnp.array([1.5, -3.5]))
    stopped, passed = ends.tolist()
    assert stopped < 2.0 < passed, ends
