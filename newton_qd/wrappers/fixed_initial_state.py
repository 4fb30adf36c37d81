"""Resets without noise."""

from __future__ import annotations

from typing import Any

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.envs.base import Env
from newton_qd.envs.state import State
from newton_qd.types import RNGKey
from newton_qd.wrappers.base import Wrapper, unsupported


class FixedInitialStateWrapper(Wrapper):
    """Begins every episode in the default pose, at rest. The key has no effect.

    The wrapper moves inside all other wrappers, directly around the base environment.
    So the other wrappers compute their first values from the fixed state.
    """

    def __init__(
        self, env: Env, base_env_name: str | None = None, get_obs_fn: None = None
    ) -> None:
        """Wraps an environment that has a ``fixed_state``.

        Args:
            env: The environment, with or without wrappers; it is not changed.
            base_env_name: Its name, used in errors.
            get_obs_fn: Must be ``None``. The wrapper of this name in
                ``newton_qd.brax_views`` takes a function.

        Raises:
            TypeError: ``env`` is not an environment, or a ``get_obs_fn`` is given.
            NotImplementedError: The environment has no ``fixed_state``.
        """
        checks.environment(env, needs="unwrapped")
        base = env.unwrapped
        if get_obs_fn is not None:
            allowed = (
                "None; a function of (qp, info, action) goes to "
                "newton_qd.brax_views.FixedInitialStateWrapper"
            )
            raise TypeError(message("get_obs_fn", get_obs_fn, allowed))
        if not callable(getattr(base, "fixed_state", None)):
            allowed = "environments with a method fixed_state(), as every PhysicsEnv"
            raise NotImplementedError(
                unsupported(env, base_env_name or base.name, allowed)
            )
        self._env_name = base_env_name
        self._effective = env is base
        super().__init__(env if self._effective else env.with_base(self._around))

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode; the key is not used.

        Raises:
            ValueError: The environment is float64 and JAX x64 is off.
        """
        if not self._effective:
            return self.env.reset(rng)
        # asks the current inner environment, because ``with_base`` may have changed it
        inside: Any = self.env
        return self._first(inside.fixed_state())

    def _around(self, inside: Env) -> Env:
        """Returns this wrapper directly around an environment."""
        return FixedInitialStateWrapper(inside, self._env_name)

    def _first(self, state: State) -> State:
        """Returns the first state of an episode."""
        return state
