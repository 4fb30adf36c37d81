"""A maze with a target in one corner."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from newton_qd.envs.base import Env
from newton_qd.envs.state import State
from newton_qd.envs.vectors import length
from newton_qd.scenes import MAZE
from newton_qd.wrappers.scene_task import SceneTaskWrapper

_HEIGHTS = (0.2, 5.0)  # an episode ends if the torso is not between these [m]


class MazeWrapper(SceneTaskWrapper):
    """A maze of 45 m by 45 m with borders, three walls inside, and a target.

    The observation begins with (x - 17.5, y - 17.5) / 22.5. The reward is minus the
    horizontal distance of the torso from the target [m], also at a reset. Done when the
    torso is below 0.2 m or above 5 m. An episode does not end at the target.
    """

    scene = MAZE
    xy_centre = (17.5, 17.5)
    xy_scale = (22.5, 22.5)

    def __init__(self, env: Env, env_name: str) -> None:
        """Wraps a simulated robot with a floating torso; ``env`` is not changed.

        Args:
            env: The environment, with or without wrappers.
            env_name: Its name, used in errors.

        Raises:
            NotImplementedError: The environment is not such a robot.
            ValueError: The robot has a scene already.
        """
        super().__init__(env, env_name)
        system = self.system
        self._target = system.scene_frames[system.scene_links.index("target"), :2]

    def _outcome(self, state: State) -> State:
        """Returns the state with the reward and the end of the task."""
        position = self._position(state)
        away = position[:2] - np.asarray(self._target, self.dtype)
        low, high = (np.asarray(height, self.dtype) for height in _HEIGHTS)
        outside = (position[2] < low) | (position[2] > high)
        # a world that has a fault is frozen: reward 0 and done 1, as without this
        # wrapper
        faulty = state.info["fault"] != 0
        reward = -length(away)
        return state.replace(
            reward=jnp.where(faulty, jnp.zeros_like(reward), reward),
            done=(outside | faulty).astype(self.dtype),
        )
