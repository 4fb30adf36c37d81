"""Rewards without the forward part."""

from __future__ import annotations

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.envs.base import Env, PhysicsEnv
from newton_qd.envs.rollouts import RolloutOrder
from newton_qd.envs.state import State
from newton_qd.types import Action, Params
from newton_qd.wrappers.base import Wrapper, refuse_second, unsupported


class NoForwardRewardWrapper(Wrapper):
    """Subtracts the forward part from the reward of a step; metrics do not change."""

    rollout_order = RolloutOrder.AT_ONCE

    def __init__(self, env: Env, env_name: str) -> None:
        """Wraps a simulated robot whose reward has a forward part.

        Args:
            env: The environment; its class has a ``forward_reward_name``. If actions
                are repeated, put this wrapper inside the ``EpisodeWrapper``.
            env_name: Its name, used in errors.

        Raises:
            NotImplementedError: The reward has no forward part.
            TypeError: ``env`` is not an environment.
            ValueError: The environment repeats actions, or has this wrapper already.
        """
        checks.environment(env, needs="unwrapped")
        why = "and the forward part would be subtracted twice"
        refuse_second(env, NoForwardRewardWrapper, why)
        base = env.unwrapped
        name = base.forward_reward_name if isinstance(base, PhysicsEnv) else None
        if name is None:
            allowed = (
                "simulated robots whose class names the metric of its forward reward "
                "as forward_reward_name"
            )
            raise NotImplementedError(unsupported(env, env_name, allowed))
        repeat = getattr(env, "action_repeat", 1)
        if repeat != 1:
            given = Fact(f"an environment that repeats actions {repeat} times")
            allowed = (
                "one that does not, as metrics are of the last repetition alone; "
                "EpisodeWrapper may go around it"
            )
            raise ValueError(message("env", given, allowed))
        super().__init__(env)
        self._forward_reward = name

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances by one step.

        Raises:
            TypeError: The state or the action has the wrong type.
            ValueError: The state comes from another environment, or the action has the
                wrong shape.
        """
        state = self.env.step(state, action, params)
        forward = state.metrics[self._forward_reward]
        return state.replace(reward=state.reward - forward)
