"""Scenes as data: obstacles on the ground, one spec each."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Scene:
    """Static obstacles, and the links of a robot that collide with them.

    Attributes:
        name: Name of the scene.
        urdf: File name inside ``urdf/``, or a path: links that are fixed to the
            world, with capsules, spheres or boxes as colliders.
        links: Links of the robot whose colliders all touch the obstacles; ``None``: the
            links that touch the ground.
    """

    name: str
    urdf: str
    links: tuple[str, ...] | None = None


TRAP = Scene("trap", "trap.urdf")
HUMANOID_TRAP = Scene("humanoid_trap", "humanoid_trap.urdf")
MAZE = Scene("maze", "maze.urdf")
ANTMAZE_U = Scene("antmaze_u", "antmaze_u.urdf")
ANTMAZE_BIG = Scene("antmaze_big", "antmaze_big.urdf")
ANTMAZE_HARDEST = Scene("antmaze_hardest", "antmaze_hardest.urdf")
# the torso too: its position is the descriptor
HUMANOID_MAZE = Scene(
    "humanoid_maze", "humanoid_maze.urdf", ("torso", "left_shin", "right_shin")
)
HURDLES = Scene("hurdles", "hurdles.urdf")

SCENES = {
    scene.name: scene
    for scene in (
        TRAP,
        HUMANOID_TRAP,
        MAZE,
        ANTMAZE_U,
        ANTMAZE_BIG,
        ANTMAZE_HARDEST,
        HUMANOID_MAZE,
        HURDLES,
    )
}
