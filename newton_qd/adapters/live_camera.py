"""Pictures of a state, while an episode runs."""

from __future__ import annotations

from typing import Any

import numpy as np

from newton_qd.adapters.pickled import Pickled
from newton_qd.envs.base import Env, PhysicsEnv
from newton_qd.envs.state import State

_AREA = 20.0  # half width of the grid on the ground [radii of the robot, or lines]


class LiveCamera(Pickled):
    """Takes pictures; builds the scene again if a robot leaves its grid."""

    rebuilt = ("_camera",)

    def __init__(self, env: Env, width: int, height: int) -> None:
        """Prepares the pictures; the scene is built at the first one.

        Args:
            env: The environment.
            width: Width of a picture [px].
            height: Height of a picture [px].
        """
        from newton_qd.viewing import drawing_of

        self._drawing = drawing_of(env)
        self._physical = isinstance(env.unwrapped, PhysicsEnv)
        self._size = width, height
        self._rebuild()
        self._centre = np.zeros(2)

    def _rebuild(self) -> None:
        self._camera: Any = None

    def picture(self, state: State) -> np.ndarray:
        """Returns a picture (height, width, 3), uint8, of the state of one world."""
        from newton_qd.viewing.camera import Camera
        from newton_qd.viewing.drawing import body_frames

        q = np.asarray(state.pipeline_state.q if self._physical else state.obs)
        drawing = self._drawing
        place = body_frames(drawing, q)[drawing.torso, :2]
        reach = _AREA * max(drawing.radius, drawing.grid)
        if self._camera is None or np.abs(place - self._centre).max() > reach / 2:
            area = place - reach, place + reach
            self._camera = Camera(drawing, area, *self._size)
            self._centre = place
        return self._camera.picture(q)
