"""Plays a trajectory in a viewer of Newton."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from newton_qd import checks
from newton_qd.viewing.drawing import body_frames
from newton_qd.viewing.newton_model import newton_model
from newton_qd.viewing.trajectory import Trajectory

if TYPE_CHECKING:
    from newton.viewer import ViewerBase

_GRID = 8.0  # half width of the grid around the way of a robot [radii]


def play(
    trajectory: Trajectory,
    viewer: ViewerBase,
    *,
    world: int = 0,
    speed: float | None = None,
) -> None:
    """Plays a world of a trajectory in a viewer of Newton.

    ``newton.viewer`` has viewers for a window, a browser and files: ``ViewerGL``,
    ``ViewerViser``, ``ViewerRerun``, ``ViewerUSD``, ``ViewerFile``. Some need packages
    of their own.

    Args:
        trajectory: The trajectory.
        viewer: The viewer. It stays open; call its ``close`` to finish a file.
        world: Number of the world.
        speed: Playing speed relative to real time; ``None``: as fast as possible, for
            files.

    Raises:
        IndexError: There is no such world.
        ValueError: ``speed`` is not above 0.
    """
    checks.number("speed", speed, above=0, optional=True)
    one, drawing = trajectory.world(world), trajectory.drawing
    frames = body_frames(drawing, one.q[0, : int(one.lengths[0]) + 1])
    torso = frames[:, drawing.torso, :2]
    reach = _GRID * drawing.radius
    model = newton_model(
        drawing, (torso.min(axis=0) - reach, torso.max(axis=0) + reach)
    )
    state = model.state()
    assert state.body_q is not None
    viewer.set_model(model)
    for number, poses in enumerate(frames):
        if not viewer.is_running():
            return
        state.body_q.assign(poses.astype(np.float32))
        viewer.begin_frame(number * one.dt)
        viewer.log_state(state)
        viewer.end_frame()
        if speed is not None:
            time.sleep(one.dt / speed)
