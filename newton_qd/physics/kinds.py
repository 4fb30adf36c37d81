"""Kinds of joints and obstacles: the one table that models and kernels read."""

import enum


class JointKind(enum.IntEnum):
    """Joint types that the kernels know."""

    FREE = 0
    REVOLUTE = 1
    PRISMATIC = 2


class ObstacleKind(enum.IntEnum):
    """Shapes that a robot may touch."""

    PLANE = 0
    CAPSULE = 1
    BOX = 2
