"""Kinds of joints and obstacles. Models and kernels both read them from here."""

import enum


class JointKind(enum.IntEnum):
    """Joint types that the kernels support."""

    FREE = 0
    REVOLUTE = 1
    PRISMATIC = 2


class ObstacleKind(enum.IntEnum):
    """Shapes of obstacles that the kernels support."""

    PLANE = 0
    CAPSULE = 1
    BOX = 2
