"""Shared code of trap and maze: walls, and the robot's position among them."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.envs.base import Env, PhysicsEnv
from newton_qd.envs.rollouts import RolloutOrder
from newton_qd.envs.state import State
from newton_qd.envs.vectors import rounded
from newton_qd.physics.system import JointKind, System
from newton_qd.scenes import Scene
from newton_qd.types import Action, Params, RNGKey
from newton_qd.wrappers.base import Wrapper, unsupported

Corners = tuple[tuple[float, float], tuple[float, float]]
"""Lowest x and y, and highest x and y [m]."""


class SceneTaskWrapper(Wrapper):
    """Adds a scene, and puts the scaled position at the front of the observation.

    The wrapper moves inside all other wrappers, directly around the base environment.
    So the other wrappers see the rewards of the task and the ends of its episodes.
    """

    scene: Scene
    """The walls."""
    area: Corners
    """Positions with the observations -1 and 1 [m]."""

    rollout_order = RolloutOrder.AT_ONCE

    def __init__(self, env: Env, env_name: str) -> None:
        """Wraps a simulated robot with a floating torso; ``env`` is not changed.

        Args:
            env: The environment, with or without wrappers.
            env_name: Its name, used in errors.

        Raises:
            NotImplementedError: The environment is not such a robot.
            TypeError: ``env`` is not an environment.
            ValueError: The robot has a scene already.
        """
        checks.environment(env, needs="unwrapped")
        base = env.unwrapped
        if not isinstance(base, PhysicsEnv) or not _floats(base.system):
            raise NotImplementedError(
                unsupported(env, env_name, "simulated robots whose torso floats")
            )
        if base.system.scene is not None:
            given = Fact(f"{env_name} in the scene {base.system.scene.name!r}")
            raise ValueError(message("env", given, "robots without a scene"))
        self._effective = env is base
        if self._effective:
            env = base.with_scene(self.scene)
        else:
            env = env.with_base(lambda inside: self._inside(inside, env_name))
        super().__init__(env)

    def _inside(self, env: Env, env_name: str) -> Env:
        """Returns the same wrapper around another environment."""
        return type(self)(env, env_name)

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode.

        Raises:
            ValueError: The environment is float64 and JAX x64 is off.
        """
        return self._judged(self.env.reset(rng))

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances by one step.

        Raises:
            TypeError: The state or the action has the wrong type.
            ValueError: The state comes from another environment, or the action has the
                wrong shape.
        """
        return self._judged(self.env.step(state, action, params))

    def fixed_state(self) -> State:
        """Returns the state of a reset without noise.

        Raises:
            ValueError: The environment is float64 and JAX x64 is off.
        """
        inside: Any = self.env
        return self._judged(inside.fixed_state())

    def _judged(self, state: State) -> State:
        if not self._effective:
            return state
        low, high = np.asarray(self.area, self.dtype)
        centre = (low + high) / 2
        # XLA turns a division by constants into this product, but not in every program
        share = np.asarray(2, self.dtype) / (high - low)
        place = rounded((self._position(state)[:2] - centre) * share)
        return self._outcome(state.replace(obs=jnp.concatenate([place, state.obs])))

    def _outcome(self, state: State) -> State:
        """Returns the state with the reward and the end of the task."""
        return state

    def _position(self, state: State) -> jax.Array:
        """Returns the position (3,) of the torso [m]."""
        base = self.unwrapped
        assert isinstance(base, PhysicsEnv)
        start = int(base.system.q_start[base.system.torso])
        return state.pipeline_state.q[start : start + 3]

    @property
    def observation_layout(self) -> tuple[tuple[str, int], ...]:
        """Name and size of each block of the observation, in order."""
        inside: Any = self.env
        own = (("torso position x y, scaled to the scene [-]", 2),)
        return (own if self._effective else ()) + inside.observation_layout

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        if not self._effective:  # a wrapper between may have made it longer
            return self.env.observation_size
        return sum(size for _, size in self.observation_layout)


def _floats(system: System) -> bool:
    return system.joint_kind[system.torso] == JointKind.FREE
