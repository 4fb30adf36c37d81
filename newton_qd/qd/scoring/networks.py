"""Policies from networks of Flax (linen, nnx) and Equinox, and from other pytrees."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.qd.scoring.rollout import Policy, flattened, make_policy
from newton_qd.qd.scoring.task import Task
from newton_qd.types import Environment, Observation, PyTree, RNGKey

_ALLOWED = "a module of Flax linen, or a function of a key that makes a module"
_MODULE = "a module that maps an observation to an action"


def policy_of(env: Environment, network: Any) -> Policy:
    """Makes a policy with one vector of weights from a network.

    Args:
        env: Environment with ``observation_size`` and ``action_size``.
        network: A module of Flax linen. Or a function of a key that makes a module of
            Flax nnx, of Equinox, or another pytree that maps an observation (O,) to an
            action (A,). The weights are its floating-point arrays. Everything else is
            that of the module of ``jax.random.key(0)``.

    Raises:
        TypeError: ``env`` is not an environment, or ``network`` is neither, such as a
            module of Flax nnx or Equinox that is made already.
        ValueError: Actions of the network have the wrong shape.
    """
    checks.environment(env, needs="observation_size")
    return _own(env.observation_size, env.action_size, network)


def _own(observation_size: int, action_size: int, network: Any) -> Policy:
    """Makes a policy from a network of your own.

    Raises:
        TypeError: ``network`` is no network.
        ValueError: Its actions have the wrong shape.
    """
    dummy = jnp.zeros((observation_size,), jnp.float32)
    linen = hasattr(network, "init") and hasattr(network, "apply")
    if linen:
        module: Any = network

        def parts(key: RNGKey) -> tuple[Callable[[PyTree], Any], PyTree]:
            weights = module.init(key, dummy)
            return lambda tree: lambda obs: module.apply(tree, obs), weights

    else:
        if not callable(network) or _is_module(network):
            raise TypeError(message("network", network, _ALLOWED))

        def parts(key: RNGKey) -> tuple[Callable[[PyTree], Any], PyTree]:
            model = network(key)
            checks.function("network: the module for a key", model, _MODULE)
            return _split(model)

    rebuild, tree = parts(jax.random.key(0))
    leaves, structure = jax.tree.flatten(tree)
    moving = [_is_weight(leaf) for leaf in leaves]
    zeros = [np.zeros(x.shape, x.dtype) for x in leaves if _is_weight(x)]
    size, unravel = flattened(zeros)

    def init(key: RNGKey) -> jax.Array:
        made = jax.tree.leaves(parts(key)[1])
        return ravel_pytree([x for x in made if _is_weight(x)])[0]

    def apply(parameters: PyTree, observation: Observation) -> jax.Array:
        weights = iter(parameters)
        merged = [
            next(weights) if moves else leaf
            for leaf, moves in zip(leaves, moving, strict=True)
        ]
        model = rebuild(jax.tree.unflatten(structure, merged))
        return jnp.asarray(model(observation))

    given = jax.eval_shape(apply, zeros, dummy).shape
    if given != (action_size,):
        wrong = Fact(f"actions of shape {given}")
        raise ValueError(message("network", wrong, f"shape {(action_size,)}"))
    return Policy(
        size=size,
        init=init,
        unravel=unravel,
        apply=apply,
        ravel=lambda parameters: ravel_pytree(parameters)[0],
        network=network if linen else None,
    ).made_by(_own, observation_size, action_size, network)


def policy_for(task: Task, hidden: tuple[int, ...]) -> Policy:
    """Returns the policy of a task: its own network, or a perceptron.

    Args:
        task: The task.
        hidden: Widths of the hidden layers of a perceptron.

    Raises:
        MissingExtra: QDax is not installed.
        ValueError: Actions of the network have the wrong shape.
    """
    if task.network is None:
        return make_policy(task.env, hidden)
    return policy_of(task.env, task.network)


def _is_weight(leaf: object) -> bool:
    """Returns whether a leaf is an array of floating-point numbers."""
    return checks.is_array(leaf) and jnp.issubdtype(jnp.result_type(leaf), jnp.floating)


def _is_module(network: Any) -> bool:
    """Returns whether a network is a module of Flax nnx or Equinox, not its maker."""
    nnx: Any = sys.modules.get("flax.nnx")
    if nnx is not None and isinstance(network, nnx.Module):
        return True
    function = isinstance(network, (type, jax.tree_util.Partial))
    return not function and any(map(_is_weight, jax.tree.leaves(network)))


def _split(model: Any) -> tuple[Callable[[PyTree], Any], PyTree]:
    """Returns a module as a pytree, and the function that undoes this."""
    nnx: Any = sys.modules.get("flax.nnx")  # whoever has a module of it imported it
    if nnx is not None and isinstance(model, nnx.Module):
        graph, state = nnx.split(model)
        return lambda tree: nnx.merge(graph, tree), state
    return lambda tree: tree, model
