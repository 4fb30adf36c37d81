"""Batches of worlds."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks, memory
from newton_qd.checks import Fact, message
from newton_qd.envs.base import Env
from newton_qd.envs.inputs import require_key, require_state
from newton_qd.envs.state import State
from newton_qd.physics.parameters import check_values
from newton_qd.types import Action, Params, RNGKey
from newton_qd.wrappers.base import Wrapper, outermost

_MANY = 100_000  # worlds; for fewer, the check is not worth the time to trace a reset


class VectorWrapper(Wrapper):
    """Steps a batch of worlds; the first axis of every leaf of a state is the batch.

    Attributes:
        batch_size: Number of worlds of a reset. A step takes any number of worlds.
    """

    def __init__(self, env: Env, batch_size: int) -> None:
        """Wraps an environment of one world.

        Args:
            env: The environment.
            batch_size: Number of worlds of a reset.

        Raises:
            ValueError: ``batch_size`` is not an integer above 0, the states of so many
                worlds do not fit in memory, or ``env`` has a batch already.
        """
        checks.integer("batch_size", batch_size)
        inside = outermost(env, VectorWrapper)
        if inside is not None:
            given = Fact(f"{inside.batch_size} worlds")
            allowed = "environments of one world (jax.vmap nests batches)"
            raise ValueError(message("env", given, allowed))
        if batch_size > _MANY:
            needed, most = batch_size * state_bytes(env), memory.limit_here()
            memory.check("batch_size", batch_size, needed, most)
        super().__init__(env)
        self.batch_size = int(batch_size)

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode in every world, from one key.

        Raises:
            TypeError: ``rng`` is not a key.
            ValueError: ``rng`` is several keys, or the environment is float64 and JAX
                x64 is off.
        """
        require_key("rng", rng)
        return jax.vmap(self.env.reset)(jax.random.split(rng, self.batch_size))

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances every world.

        Args:
            state: Batched state.
            action: (batch, nu) actions.
            params: As for one world, with the batch axis in front.

        Raises:
            TypeError: The state or the action has the wrong type.
            ValueError: State, action or parameters do not have the same batch axis in
                front.
        """
        batch = _batch(state)
        shape = (*batch, self.action_size)
        allowed = f"an array of shape {shape}"
        checks.instance("action", action, (jax.Array, np.ndarray), allowed)
        if action.shape != shape:
            raise ValueError(message("action", action, allowed))
        _require_batch(params, batch)
        return jax.vmap(self.env.step)(state, action, params)

    def rollout(self, state: State, actions: Action, params: Params = None) -> State:
        """Runs a plan of actions in every world.

        Args:
            state: Batched state.
            actions: (T, batch, nu) actions.
            params: As for one world, with the batch axis in front.

        Returns:
            The states after each step, leaves (T, batch, ...).

        Raises:
            TypeError: The state or the actions have the wrong type.
            ValueError: State, actions or parameters have the wrong shape.
        """
        batch = _batch(state)
        shape = (*batch, self.action_size)
        allowed = f"an array of shape (steps, {', '.join(map(str, shape))})"
        checks.instance("actions", actions, (jax.Array, np.ndarray), allowed)
        if jnp.shape(actions)[1:] != shape:
            raise ValueError(message("actions", actions, allowed))
        _require_batch(params, batch)
        run = jax.vmap(self.env.rollout, in_axes=(0, 1, 0), out_axes=1)
        return run(state, actions, params)

    @property
    def default_params(self) -> Params:
        """Default ``params`` of ``batch_size`` worlds."""
        size = (self.batch_size,)
        return jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, size + jnp.shape(leaf)),
            self.env.default_params,
        )


def _batch(state: State) -> tuple[int]:
    """Returns the batch axis of a state.

    Raises:
        TypeError: It is not a state.
        ValueError: It has no batch axis, or several.
    """
    if not hasattr(state, "done"):  # a class of a user may have states of its own
        require_state(state)
    batch = jnp.shape(state.done)
    if len(batch) != 1:
        allowed = "(batch,), as after a reset of this environment, without jax.vmap"
        raise ValueError(message("state: shape of done", batch, allowed))
    return batch


def _require_batch(params: Params, batch: tuple[int]) -> None:
    """Checks that parameters have the batch axis in front, and values in bounds.

    Raises:
        ValueError: One has not.
    """
    check_values(params)
    for leaf in jax.tree.leaves(params):
        if jnp.shape(leaf)[:1] != batch:
            allowed = (
                f"the batch axis {batch} in front of every array, as in default_params"
            )
            raise ValueError(message("params", leaf, allowed))


def state_bytes(env: Env) -> int:
    """Returns the size of the state of one world [bytes]."""
    state = jax.eval_shape(env.reset, jax.eval_shape(lambda: jax.random.key(0)))
    leaves = jax.tree.leaves(state)
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in leaves)
