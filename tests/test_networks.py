"""Networks of Flax and Equinox as policies of episodes, scoring functions and runs."""

from __future__ import annotations

import copy
import dataclasses
import pickle
import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import newton_qd
from newton_qd.gradients import Episode
from newton_qd.qd import (
    ConfigError,
    EvolveConfig,
    evolve,
    load_run,
    make_policy,
    make_scoring_function,
    make_task,
    policy_of,
)
from newton_qd.qd.run.search import Search

CONFIG = EvolveConfig(
    env_name="pointmaze", iterations=1, batch_size=4, episode_length=5, reevaluations=0
)
HIDDEN = 3
OBSERVATION = jnp.array([0.3, -0.5], jnp.float32)


def linen() -> Any:
    nn = pytest.importorskip("flax.linen")
    return nn.Sequential([nn.Dense(HIDDEN), jnp.tanh, nn.Dense(2), jnp.tanh])


def nnx() -> Any:
    nnx = pytest.importorskip("flax.nnx")

    class Network(nnx.Module):
        def __init__(self, rngs: Any) -> None:
            self.first = nnx.Linear(2, HIDDEN, rngs=rngs)
            self.last = nnx.Linear(HIDDEN, 2, rngs=rngs)
            self.rngs = rngs  # random keys and counters are no weights

        def __call__(self, obs: jax.Array) -> jax.Array:
            return jnp.tanh(self.last(jnp.tanh(self.first(obs))))

    return lambda key: Network(nnx.Rngs(params=key))


def equinox() -> Any:
    eqx = pytest.importorskip("equinox")
    return lambda key: eqx.nn.MLP(2, 2, HIDDEN, 1, final_activation=jnp.tanh, key=key)


NETWORKS = {"linen": linen, "nnx": nnx, "equinox": equinox}


@pytest.mark.parametrize("name", NETWORKS)
def test_weights_are_a_vector(name: str) -> None:
    network, key = NETWORKS[name](), jax.random.key(3)
    policy = policy_of(newton_qd.create("pointmaze"), network)
    assert policy.size == 2 * HIDDEN + HIDDEN + HIDDEN * 2 + 2
    weights = jax.jit(policy.init)(key)

    @jax.jit
    def answer(key: jax.Array) -> jax.Array:
        if name == "linen":
            return network.apply(network.init(key, OBSERVATION), OBSERVATION)
        return network(key)(OBSERVATION)

    found = jax.jit(policy.of_weights)(weights, OBSERVATION)
    assert np.allclose(found, answer(key), atol=1e-6)
    again = jax.jit(lambda x: policy.ravel(policy.unravel(x)))(weights)
    assert np.array_equal(again, weights)
    with pytest.raises(
        ValueError, match=r"weights: got shape \(3,\); allowed: \(17,\)"
    ):
        policy.of_weights(weights[:3], OBSERVATION)
    both = np.asarray(jax.jit(jax.vmap(policy.init))(jax.random.split(key, 2)))
    assert both.shape == (2, policy.size) and not np.array_equal(*both)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["linen", "equinox"])  # docs/networks.md runs nnx
def test_episodes_scores_and_runs(name: str, tmp_path: Path) -> None:
    network = NETWORKS[name]()

    def task_of(config: EvolveConfig) -> Any:
        return dataclasses.replace(make_task(config), network=network)

    task, key = task_of(CONFIG), jax.random.key(0)
    policy = policy_of(task.env, network)
    weights = jax.vmap(policy.init)(jax.random.split(key, 4))
    fitness, descriptors, _ = make_scoring_function(task, policy, 5)(weights, key)
    assert np.isfinite(fitness).all() and descriptors.shape == (4, 2)
    episode = Episode(task.env, policy.of_weights, episode_length=5)
    slope = jax.grad(lambda x: episode(x, key).fitness)(weights[0])
    assert np.isfinite(slope).all() and jnp.abs(slope).max() > 0
    result = evolve(CONFIG, out=tmp_path / "run", progress=False, task_factory=task_of)
    assert result.archive.genotypes.shape[1] == policy.size
    run = load_run(tmp_path / "run", task_factory=task_of)
    assert np.array_equal(
        np.ravel(run.evaluate(run.cells).fitnesses), run.archive.fitnesses[run.cells]
    )


def test_initial_weights_are_drawn_one_by_one() -> None:
    """On a CPU, two batches of QR decompositions can wait for each other forever."""
    nn = pytest.importorskip("flax.linen")
    start = nn.initializers.orthogonal()
    layers = [nn.Dense(HIDDEN, kernel_init=start), nn.Dense(2, kernel_init=start)]
    task = dataclasses.replace(make_task(CONFIG), network=nn.Sequential(layers))
    search = Search(CONFIG.resolve(task.descriptor_length), task)
    text = search._population.lower(jax.random.split(jax.random.key(0), 4)).as_text()
    shapes = re.findall(r"@lapack_sgeqrf_ffi.*: \(tensor<([\dx]+)xf32>\)", text)
    assert set(shapes) == {"3x2"}  # Flax draws the transpose of 2 x 3


def linear(key: jax.Array) -> Any:
    weights = jax.random.normal(key, (2, 2), jnp.float32)
    return jax.tree_util.Partial(jnp.dot, weights)


def test_a_policy_pickles_as_it_was_made() -> None:
    env = newton_qd.create("pointmaze")
    for policy in (make_policy(env, (3,)), policy_of(env, linear)):
        again = pickle.loads(pickle.dumps(policy))
        weights = policy.init(jax.random.key(1))
        assert again.size == policy.size
        expected = policy.of_weights(weights, OBSERVATION)
        assert np.array_equal(again.of_weights(weights, OBSERVATION), expected)
        # a changed one is another policy, which pickle cannot make again
        changed = dataclasses.replace(policy, apply=lambda weights, obs: obs)
        with pytest.raises((AttributeError, pickle.PicklingError), match="local"):
            pickle.dumps(changed)


def test_copies_of_a_policy_are_equal() -> None:
    """Otherwise a program that has it as a static argument would compile again."""
    env = newton_qd.create("pointmaze")
    for policy in (make_policy(env, (3,)), policy_of(env, linear)):
        changed = dataclasses.replace(policy, apply=lambda weights, obs: obs)
        for one in (policy, changed):
            for again in (copy.copy(one), copy.deepcopy(one)):
                assert again == one and hash(again) == hash(one)


def test_errors() -> None:
    env: Any = newton_qd.create("pointmaze")
    with pytest.raises(TypeError, match="network: got 3; allowed: a module of Flax"):
        policy_of(env, 3)
    with pytest.raises(ValueError, match=r"network: got actions of shape \(3,\)"):
        policy_of(env, lambda key: jax.tree_util.Partial(jnp.dot, jnp.ones((3, 2))))
    with pytest.raises(TypeError, match=r"network: the module for a key: got None"):
        policy_of(env, lambda key: None)


@pytest.mark.parametrize("name", ["nnx", "equinox"])
def test_a_module_that_is_made_already_is_refused(name: str) -> None:
    module = NETWORKS[name]()(jax.random.key(0))
    env: Any = newton_qd.create("pointmaze")
    with pytest.raises(
        TypeError, match=r"network: got .*; allowed: .*function of a key"
    ):
        policy_of(env, module)


def test_a_function_of_a_key_may_have_arrays() -> None:
    env: Any = newton_qd.create("pointmaze")
    network = jax.tree_util.Partial(
        lambda weights, key: jax.tree_util.Partial(jnp.dot, weights), jnp.ones((2, 2))
    )
    assert policy_of(env, network).size == 4


@pytest.mark.parametrize("algorithm", ["pga-me", "dcrl-me"])
def test_a_critic_needs_linen(algorithm: str) -> None:
    task = dataclasses.replace(make_task(CONFIG), network=nnx())
    config = dataclasses.replace(CONFIG, algorithm=algorithm)
    with pytest.raises(
        ConfigError, match=f"algorithm: got '{algorithm}', which .*linen"
    ):
        evolve(config, progress=False, task_factory=lambda config: task)


def test_a_task_factory_makes_a_task() -> None:
    nothing: Any = lambda config: None  # noqa: E731
    with pytest.raises(
        ConfigError, match=r"task_factory: got .* returned None; allowed"
    ):
        evolve(CONFIG, progress=False, task_factory=nothing)
    with pytest.raises(ConfigError, match="task_factory: got None; allowed: a functi"):
        evolve(CONFIG, progress=False, task_factory=nothing(CONFIG))
