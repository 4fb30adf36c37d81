"""A trap in front of a robot that runs forward."""

from __future__ import annotations

from newton_qd.scenes import TRAP
from newton_qd.wrappers.scene_task import SceneTaskWrapper


class TrapWrapper(SceneTaskWrapper):
    """Three walls in the shape of a U, open towards the robot.

    The side walls begin 6.5 m in front of the robot, and the back wall is at 12 m.
    The observation begins with ((x - 15) / 15, y / 8). Reward and done do not change.
    """

    scene = TRAP
    area = ((0.0, -8.0), (30.0, 8.0))
