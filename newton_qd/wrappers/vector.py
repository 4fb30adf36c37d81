"""Batches of worlds."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.envs.base import Env
from newton_qd.envs.options import check_count
from newton_qd.envs.state import State
from newton_qd.types import Action, Params, RNGKey
from newton_qd.wrappers.base import Wrapper


class VectorWrapper(Wrapper):
    """Steps a batch of worlds; every leaf of the state has the batch axis in front.

    Attributes:
        batch_size: Number of worlds that a reset makes; a step takes any number.
    """

    def __init__(self, env: Env, batch_size: int) -> None:
        check_count("batch_size", batch_size)
        inside = env
        while isinstance(inside, Wrapper):
            if isinstance(inside, VectorWrapper):
                raise ValueError(
                    f"env: {inside.batch_size} worlds already; allowed: environments "
                    "of one world (jax.vmap makes batches of batches)"
                )
            inside = inside.env
        super().__init__(env)
        self.batch_size = int(batch_size)

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
        allowed = f"allowed: an array of shape {(*batch, self.action_size)}"
        if not isinstance(action, (jax.Array, np.ndarray)):
            raise TypeError(f"action: type {type(action).__name__} given; {allowed}")
        if action.shape != (*batch, self.action_size):
            raise ValueError(f"action: shape {action.shape} given; {allowed}")
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
