"""The door to brax: its wrappers and its training code run on the environments."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import sys
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import newton_qd

pytestmark = pytest.mark.slow  # an import of brax takes two seconds


@pytest.fixture(scope="module")
def envs() -> Any:
    return pytest.importorskip("brax.envs")


@pytest.fixture(scope="module")
def adapters(envs: Any) -> Any:
    return importlib.import_module("newton_qd.adapters.brax")


@pytest.fixture(scope="module")
def hopper(adapters: Any) -> Any:
    return adapters.BraxEnv("hopper_uni")


def test_interface(envs: Any, adapters: Any, hopper: Any) -> None:
    assert isinstance(hopper, envs.Env) and hopper.unwrapped is hopper
    assert (hopper.observation_size, hopper.action_size) == (11, 3)
    assert hopper.backend == "newton_qd" and hopper.dt == hopper.env.dt
    system = hopper.sys
    assert (system.act_size(), system.q_size(), system.qd_size()) == (3, 6, 6)
    assert system.num_links() == len(system.link_names) > 3
    assert system.actuator.ctrl_range.tolist() == [[-1.0, 1.0]] * 3
    assert system.opt.timestep == hopper.dt
    maze = adapters.BraxEnv("pointmaze").sys
    assert (maze.q_size(), maze.qd_size(), maze.num_links()) == (0, 0, 0)


def test_names(envs: Any, adapters: Any) -> None:
    names = adapters.register_with_brax()
    assert names == tuple(f"newton_qd/{x}" for x in newton_qd.registered_envs())
    env = envs.create("newton_qd/pointmaze", episode_length=5, batch_size=2)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    assert state.obs.shape == (2, 2) and env.unwrapped.backend == "newton_qd"
    assert envs.get_environment("newton_qd/pointmaze", backend="newton_qd").dt == 1.0


def test_brax_resets_worlds_and_counts_their_steps(envs: Any, adapters: Any) -> None:
    env = envs.training.wrap(adapters.BraxEnv("pointmaze"), episode_length=3)
    step = jax.jit(env.step)
    first = state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 2))
    found = []
    for _ in range(4):
        state = step(state, jnp.full((2, 2), 0.5))
        found.append((float(state.done[0]), float(state.info["steps"][0])))
    assert found == [(0, 1), (0, 2), (1, 3), (0, 1)]
    assert state.info["truncation"].tolist() == [0, 0]
    once = step(first, jnp.full((2, 2), 0.5))
    assert np.array_equal(state.obs, once.obs)
    assert np.array_equal(state.info["state_descriptor"], once.obs)


@pytest.mark.optimized
def test_the_numbers_are_those_of_env_step(envs: Any, hopper: Any) -> None:
    env = newton_qd.create("hopper_uni", episode_length=None, auto_reset=False)
    keys = jax.random.split(jax.random.PRNGKey(2), 3)
    step, wanted_step = jax.jit(jax.vmap(hopper.step)), jax.jit(jax.vmap(env.step))
    state = jax.jit(jax.vmap(hopper.reset))(keys)
    wanted = jax.jit(jax.vmap(env.reset))(keys)
    for number in range(5):
        actions = jax.random.uniform(jax.random.key(number), (3, 3), minval=-1.0)
        state, wanted = step(state, actions), wanted_step(wanted, actions)
        for name in ("obs", "reward", "done", "metrics", "pipeline_state"):
            for ours, theirs in zip(
                jax.tree.leaves(getattr(state, name)),
                jax.tree.leaves(getattr(wanted, name)),
                strict=True,
            ):
                assert np.array_equal(ours, theirs)
        for name, value in wanted.info.items():
            assert np.array_equal(state.info[name], value)

    # a fault ends the episode, and brax's reset makes the world sound again
    wrapped = envs.training.wrap(hopper, episode_length=10)
    step = jax.jit(wrapped.step)
    state = jax.jit(wrapped.reset)(keys)
    bad = jnp.zeros((3, 3)).at[1].set(jnp.nan)
    state = step(state, bad)
    assert state.done.tolist() == state.info["fault"].tolist() == [0, 1, 0]
    state = step(state, jnp.zeros((3, 3)))
    assert state.info["fault"].tolist() == state.done.tolist() == [0, 0, 0]
    assert np.isfinite(state.obs).all() and np.isfinite(state.reward).all()


def test_each_world_its_own_physics(envs: Any, hopper: Any) -> None:
    """brax's own domain randomization, with masses of this library."""

    def heavier(system: Any) -> tuple[Any, Any]:
        scale = jnp.array([1.0, 2.0])
        params = system.params
        mass = scale[:, None] * params.mass_scale
        axes = jax.tree.map(lambda _: None, params, is_leaf=lambda x: x is None)
        return (
            system.replace(params=dataclasses.replace(params, mass_scale=mass)),
            system.replace(params=dataclasses.replace(axes, mass_scale=0)),
        )

    env = envs.training.wrap(hopper, 10, randomization_fn=heavier)
    keys = jnp.stack([jax.random.PRNGKey(0)] * 2)
    state = jax.jit(env.step)(jax.jit(env.reset)(keys), jnp.full((2, 3), 0.5))
    assert hopper.sys.params.mass_scale.ndim == 1
    assert not np.allclose(state.obs[0], state.obs[1], atol=1e-3)


def test_parameters_are_replaced_by_name(adapters: Any, hopper: Any) -> None:
    system = hopper.sys.tree_replace({"params.friction": jnp.float32(0.5)})
    assert float(system.params.friction) == 0.5
    assert system.params.mass_scale is hopper.sys.params.mass_scale
    axes = jax.tree.map(lambda _: None, hopper.sys)
    axes = axes.tree_replace({"params.mass_scale": 0})
    assert axes.params.mass_scale == 0 and axes.params.friction is None
    with pytest.raises(ValueError, match=r"changes: got 'geom_friction'; allowed: pa"):
        hopper.sys.tree_replace({"geom_friction": 1.0})
    maze = adapters.BraxEnv("pointmaze").sys
    assert maze.tree_replace({}).params is None
    with pytest.raises(ValueError, match=r"got 'params.friction'; allowed: none"):
        maze.tree_replace({"params.friction": 1.0})


def replicated(tree: Any, devices: list[jax.Device]) -> Any:
    """As ``jax.device_put_replicated``, which JAX 0.10 has lost and brax 0.14 calls."""
    mesh = jax.sharding.Mesh(np.array(devices), ("device",))
    rows = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("device"))
    return jax.tree.map(
        lambda leaf: jax.device_put(
            jnp.stack([jnp.asarray(leaf)] * len(devices)), rows
        ),
        tree,
    )


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize(
    ("agent", "name", "options", "widths"),
    [
        (
            "ppo",
            "hopper_uni",
            {"num_minibatches": 2, "unroll_length": 5, "run_evals": False},
            ("policy_hidden_layer_sizes", "value_hidden_layer_sizes"),
        ),
        (
            "sac",
            "pointmaze",
            {"min_replay_size": 8, "max_replay_size": 64},
            ("hidden_layer_sizes",),
        ),
    ],
)
def test_brax_trains_on_it(
    agent: str,
    name: str,
    options: dict[str, Any],
    widths: tuple[str, ...],
    adapters: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(jax, "device_put_replicated", replicated, raising=False)
    folder = f"brax.training.agents.{agent}"
    train = importlib.import_module(f"{folder}.train").train
    networks = importlib.import_module(f"{folder}.networks")
    make = getattr(networks, f"make_{agent}_networks")
    small = functools.partial(make, **dict.fromkeys(widths, (4,)))
    few = {"episode_length": 10, "num_envs": 4, "num_eval_envs": 4, "batch_size": 4}
    env = adapters.BraxEnv(name)
    make_policy, parameters, metrics = train(
        env,
        num_timesteps=40,
        network_factory=small,
        **few,
        **options,
    )
    losses = [value for key, value in metrics.items() if key.endswith("loss")]
    assert len(losses) >= 3 and np.isfinite(losses).all()
    if agent == "sac":
        assert metrics["eval/avg_episode_length"] == 10
    policy = make_policy(parameters, deterministic=True)
    action, _ = policy(jnp.zeros((env.observation_size,)), jax.random.PRNGKey(0))
    assert action.shape == (env.action_size,) and np.isfinite(action).all()


@pytest.mark.parametrize(
    ("make", "error", "text"),
    [
        (lambda env: env("no_such"), NotImplementedError, "known names"),
        (lambda env: env(cast("Any", 3)), TypeError, "env: got 3; allowed: a name of"),
        (
            lambda env: env("pointmaze", backend="mjx"),
            ValueError,
            "backend: got 'mjx', a physics of brax; allowed: None, newton_qd",
        ),
        (
            lambda env: env("pointmaze").step(cast("Any", None), jnp.zeros(2)),
            TypeError,
            "state: got None; allowed: a state, as reset",
        ),
        (
            lambda env: env("pointmaze", eval_metrics=True),
            ValueError,
            "eval_metrics: got True, which needs an episode length.*allowed: False",
        ),
        (
            lambda env: env("pointmaze", brax_views=True),
            ValueError,
            "brax_views: got True, the bodies of brax v1, which.*; allowed: False",
        ),
        (
            lambda env: env("ant_omni").step(
                jax.eval_shape(env("pointmaze").reset, jax.random.key(0)), jnp.zeros(8)
            ),
            ValueError,
            "state: got info without 'xy_position'; allowed: a state of this environm",
        ),
        (
            lambda env: env("pointmaze", episode_length=5),
            ValueError,
            "env: got an environment with an episode length; allowed: one world",
        ),
    ],
)
def test_errors(adapters: Any, make: Any, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        make(adapters.BraxEnv)


def test_a_missing_brax_says_its_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "brax", None)
    monkeypatch.delitem(sys.modules, "newton_qd.adapters.brax", raising=False)
    with pytest.raises(newton_qd.MissingExtra, match=r"newton_qd\[brax\]"):
        importlib.import_module("newton_qd.adapters.brax")
