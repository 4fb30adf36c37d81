"""Resets without noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from newton_qd.envs.base import Env, PhysicsEnv
from newton_qd.envs.state import State
from newton_qd.envs.views import QP, Info
from newton_qd.types import RNGKey
from newton_qd.wrappers.base import Wrapper

ObservationFunction = Callable[[QP, Info, jax.Array], jax.Array]


class FixedInitialStateWrapper(Wrapper):
    """Begins every episode in the default pose, at rest, whatever the key.

    It takes effect directly around the environment inside all wrappers, wherever it
    is put: so the other wrappers read their first values from the state that is
    really used.
    """

    def __init__(
        self,
        env: Env,
        base_env_name: str | None = None,
        get_obs_fn: ObservationFunction | None = None,
    ) -> None:
        """Wraps an environment that has a ``fixed_state``.

        Args:
            env: The environment, with or without wrappers; it is not changed.
            base_env_name: Its name, for the error.
            get_obs_fn: Makes the observation of a reset from ``(qp, info, action)``:
                the bodies, what ``env.sys.info(qp)`` reports, and a zero action.
                ``None``: that of the environment.
        """
        base = env.unwrapped
        if get_obs_fn is not None and not callable(get_obs_fn):
            raise TypeError(
                f"get_obs_fn={get_obs_fn!r}: allowed: None, or a function of (qp, "
                "info, action)"
            )
        if get_obs_fn is not None and not isinstance(base, PhysicsEnv):
            raise NotImplementedError(
                f"This wrapper does not support {base_env_name or base.name} yet. "
                f"get_obs_fn={get_obs_fn!r} with {type(base).__name__}; allowed: None"
            )
        if not callable(getattr(base, "fixed_state", None)):
            raise NotImplementedError(
                f"This wrapper does not support {base_env_name or base.name} yet. "
                f"Given: {type(base).__name__}; allowed: environments with a method "
                "fixed_state(), as every PhysicsEnv"
            )
        self._effective = env is base
        if not self._effective:
            env = env.with_base(
                lambda inside: FixedInitialStateWrapper(
                    inside, base_env_name, get_obs_fn
                )
            )
        super().__init__(env)
        self._get_obs_fn = get_obs_fn

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode; the key is not used."""
        if not self._effective:
            return self.env.reset(rng)
        # of what is inside now: ``with_base`` may have put something else there
        inside: Any = self.env
        state: State = inside.fixed_state()
        return state if self._get_obs_fn is None else self._observed(state)

    def _observed(self, state: State) -> State:
        """Returns the state with the observation of ``get_obs_fn``."""
        base = self.unwrapped
        assert isinstance(base, PhysicsEnv) and self._get_obs_fn is not None
        qp, action = state.qp, jnp.zeros((self.action_size,), self.dtype)
        obs = jnp.asarray(self._get_obs_fn(qp, base.sys.info(qp), action))
        if obs.shape != state.obs.shape:
            raise ValueError(
                f"get_obs_fn: returned shape {obs.shape}; allowed: {state.obs.shape}, "
                "as the observations of the steps"
            )
        return state.replace(obs=obs.astype(self.dtype))
