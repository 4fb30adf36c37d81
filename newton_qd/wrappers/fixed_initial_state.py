"""Resets without noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from newton_qd.envs.base import Env
from newton_qd.envs.state import State
from newton_qd.types import RNGKey
from newton_qd.wrappers.base import Wrapper


class FixedInitialStateWrapper(Wrapper):
    """Begins every episode in the default pose, at rest, whatever the key.

    It takes effect directly around the environment inside all wrappers, wherever it
    is put: so the other wrappers read their first values from the state that is
    really used.
    """

    def __init__(self, env: Env, base_env_name: str | None = None) -> None:
        """Wraps an environment that has a ``fixed_state``.

        Args:
            env: The environment, with or without wrappers; it is not changed.
            base_env_name: Its name, for the error.
        """
        base = env.unwrapped
        fixed_state = getattr(base, "fixed_state", None)
        if not callable(fixed_state):
            raise NotImplementedError(
                f"This wrapper does not support {base_env_name or base.name} yet. "
                f"Given: {type(base).__name__}; allowed: environments with a method "
                "fixed_state(), as every PhysicsEnv"
            )
        self._fixed_state: Callable[[], Any] | None = None
        if env is base:
            self._fixed_state = fixed_state
        else:
            env = env.with_base(
                lambda inside: FixedInitialStateWrapper(inside, base_env_name)
            )
        super().__init__(env)

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode; the key is not used."""
        if self._fixed_state is None:
            return self.env.reset(rng)
        return self._fixed_state()
