"""Resets without noise."""

from __future__ import annotations

from newton_qd.envs.base import Env, PhysicsEnv
from newton_qd.envs.state import State
from newton_qd.types import RNGKey
from newton_qd.wrappers.base import Wrapper


class FixedInitialStateWrapper(Wrapper):
    """Begins every episode in the default pose, at rest, whatever the key.

    It goes directly around the environment, inside all others: so the other
    wrappers read their first values from the state that is really used.
    """

    def __init__(self, env: Env) -> None:
        if not isinstance(env, PhysicsEnv):
            raise NotImplementedError(
                f"This wrapper does not support {env.name} yet. Given: "
                f"{type(env).__name__}; allowed: a PhysicsEnv without a wrapper"
            )
        super().__init__(env)
        self._fixed_state = env.fixed_state

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode; the key is not used."""
        del rng
        return self._fixed_state()
