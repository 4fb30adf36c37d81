"""Resets without noise, with an observation by a function."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from newton_qd import checks
from newton_qd.brax_views.views import QP, Info, SystemView, qp_view
from newton_qd.checks import message
from newton_qd.envs.base import Env, PhysicsEnv
from newton_qd.envs.state import State
from newton_qd.wrappers import fixed_initial_state
from newton_qd.wrappers.base import unsupported

ObservationFunction = Callable[[QP, Info, jax.Array], jax.Array]


class FixedInitialStateWrapper(fixed_initial_state.FixedInitialStateWrapper):
    """Begins every episode in the default pose, with an optional observation function.

    This is the wrapper of the same name with the third argument that QDax has.
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
            base_env_name: Its name, used in errors.
            get_obs_fn: Computes the observation of a reset from ``(qp, info, action)``:
                the bodies, the result of ``env.sys.info(qp)``, and a zero action.
                ``None``: the observation of the environment.

        Raises:
            TypeError: ``env`` is not an environment, or ``get_obs_fn`` no function.
            NotImplementedError: The environment has no ``fixed_state``. Or
                ``get_obs_fn`` is given and the environment has no bodies.
        """
        checks.environment(env, needs="unwrapped")
        base = env.unwrapped
        allowed = "a function of (qp, info, action)"
        checks.function("get_obs_fn", get_obs_fn, allowed, optional=True)
        if get_obs_fn is not None and not isinstance(base, PhysicsEnv):
            allowed = "simulated robots, or get_obs_fn=None"
            raise NotImplementedError(
                unsupported(env, base_env_name or base.name, allowed)
            )
        self._get_obs_fn = get_obs_fn
        super().__init__(env, base_env_name)

    def _around(self, inside: Env) -> Env:
        return FixedInitialStateWrapper(inside, self._env_name, self._get_obs_fn)

    def _first(self, state: State) -> State:
        """Returns the state with the observation of ``get_obs_fn``.

        Raises:
            ValueError: The observation has the wrong shape.
        """
        if self._get_obs_fn is None:
            return state
        base = self.unwrapped
        assert isinstance(base, PhysicsEnv)
        qp = qp_view(base.system, state.pipeline_state)
        action = jnp.zeros((self.action_size,), self.dtype)
        info = SystemView(base.system).info(qp)
        obs = jnp.asarray(self._get_obs_fn(qp, info, action))
        if obs.shape != state.obs.shape:
            allowed = f"shape {state.obs.shape}, as the observations of the steps"
            raise ValueError(message("get_obs_fn", obs, allowed))
        return state.replace(obs=obs.astype(self.dtype))
