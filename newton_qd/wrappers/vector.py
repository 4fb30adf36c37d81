"""Batches of worlds."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd.envs.base import Env
from newton_qd.envs.state import State
from newton_qd.types import Action, Params, RNGKey
from newton_qd.wrappers.base import Wrapper


class VectorWrapper(Wrapper):
    """Steps a batch of worlds; every leaf of the state has the batch axis in front.

    Attributes:
        batch_size: Number of worlds that a reset makes; a step takes any number.
    """

    def __init__(self, env: Env, batch_size: int) -> None:
        integer = isinstance(batch_size, int) and not isinstance(batch_size, bool)
        if not integer or batch_size < 1:
            raise ValueError(f"batch_size={batch_size!r}: allowed: integers from 1")
        super().__init__(env)
        self.batch_size = batch_size

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode in every world, from one key."""
        return jax.vmap(self.env.reset)(jax.random.split(rng, self.batch_size))

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances every world.

        Args:
            state: Batched state.
            action: (batch, nu) actions.
            params: As for the environment inside, with the batch axis in front.
        """
        batch = jnp.shape(state.done)
        if len(batch) != 1:
            raise ValueError(
                f"state: done has shape {batch}; allowed: (batch,), as after a reset "
                "of this environment"
            )
        if jnp.shape(action)[:1] != batch:
            raise ValueError(
                f"action: shape {jnp.shape(action)} given; allowed: "
                f"{(*batch, self.action_size)}"
            )
        for leaf in jax.tree.leaves(params):
            if jnp.shape(leaf)[:1] != batch:
                raise ValueError(
                    f"params: an array of shape {jnp.shape(leaf)} given; allowed: the "
                    f"batch axis {batch} in front of every one, as in default_params"
                )
        return jax.vmap(self.env.step)(state, action, params)

    @property
    def default_params(self) -> Params:
        """Those of the environment inside, for each of ``batch_size`` worlds."""
        size = (self.batch_size,)
        return jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, size + jnp.shape(leaf)),
            self.env.default_params,
        )
