"""A maze with a target."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, listed, message
from newton_qd.envs.base import Env, PhysicsEnv
from newton_qd.envs.limits import within
from newton_qd.envs.state import State
from newton_qd.envs.vectors import length
from newton_qd.scenes import MAZE, Scene
from newton_qd.wrappers.scene_task import Corners, SceneTaskWrapper


class MazeWrapper(SceneTaskWrapper):
    """A maze with walls and a target.

    The observation begins with x and y of the torso, scaled so that they are -1 and 1
    at the borders of ``area``. The reward is minus the horizontal distance of the torso
    from the target [m], also at a reset. Done when the height of the torso is not
    within ``heights``. An episode does not end at the target. Options of the robot for
    its reward and its end have no effect. The defaults are those of ``antmaze``: 45 m
    by 45 m with three walls inside, and heights of 0.2 to 5 m.
    """

    scene: Scene = MAZE
    area: Corners = ((-5.0, -5.0), (40.0, 40.0))
    heights: tuple[float, float] = (0.2, 5.0)
    """An episode ends if the torso is not between these [m]."""

    def __init__(
        self,
        env: Env,
        env_name: str,
        scene: Scene | None = None,
        area: Corners | None = None,
        heights: tuple[float, float] | None = None,
    ) -> None:
        """Wraps a simulated robot with a floating torso; ``env`` is not changed.

        Args:
            env: The environment, with or without wrappers.
            env_name: Its name, used in errors.
            scene: The walls, and a link ``target``; ``None``: the maze of ``antmaze``.
            area: Lowest x and y, and highest x and y, inside the borders [m]; ``None``:
                those of ``antmaze``.
            heights: Lowest and highest height of the torso [m]; ``None``: 0.2 and 5.

        Raises:
            NotImplementedError: The environment is not such a robot.
            TypeError: An argument has the wrong type.
            ValueError: The robot has a scene already, the scene cannot be built or has
                no target, or the area or the heights are not ranges.
        """
        allowed = "a newton_qd.Scene"
        checks.instance("scene", scene, Scene, allowed, optional=True)
        if scene is not None:
            self.scene = scene
        if area is not None:
            _check_area(area)
            self.area = area
        if heights is not None:
            checks.interval("heights", heights)
            self.heights = heights
        super().__init__(env, env_name)
        self._target_place()  # its error comes before the first episode

    def _target_place(self) -> np.ndarray:
        """Returns x and y (2,) of the target [m].

        Raises:
            ValueError: The scene has none.
        """
        system = self.system
        links = system.scene_links
        if "target" not in links:
            scene = None if system.scene is None else system.scene.name
            given = Fact(f"{scene!r} with {listed(links)}")
            raise ValueError(message("scene", given, "a scene with a link 'target'"))
        return system.scene_frames[links.index("target"), :2]

    def with_base(self, change: Callable[[Env], Env]) -> Env:
        """Returns the same wrappers around another environment.

        Raises:
            ValueError: It has no target.
        """
        changed: Any = super().with_base(change)
        changed._target_place()
        return changed

    def _inside(self, env: Env, env_name: str) -> Env:
        return type(self)(env, env_name, self.scene, self.area, self.heights)

    def _outcome(self, state: State) -> State:
        """Returns the state with the reward and the end of the task."""
        position = self._position(state)
        away = position[:2] - np.asarray(self._target_place(), self.dtype)
        base = self.unwrapped
        assert isinstance(base, PhysicsEnv)
        safe = within(position[2], self.heights, base.termination_width)
        # a world that has a fault is frozen: reward 0 and done 1, as without this
        # wrapper
        faulty = state.info["fault"] != 0
        reward = -length(away)
        return state.replace(
            reward=jnp.where(faulty, jnp.zeros_like(reward), reward),
            done=jnp.where(faulty, jnp.ones_like(safe), 1 - safe),
        )


def _check_area(area: object) -> None:
    """Checks the corners of an area.

    Raises:
        ValueError: They are not two points, the lowest values first.
    """
    try:
        corners = np.asarray(area, np.float64)
    except (TypeError, ValueError):
        corners = np.zeros(())
    finite = corners.shape == (2, 2) and np.all(np.isfinite(corners))
    if not finite or not np.all(corners[0] < corners[1]):
        allowed = "lowest and highest x and y, such as ((0.0, 0.0), (9.0, 9.0))"
        raise ValueError(message("area", area, allowed))
