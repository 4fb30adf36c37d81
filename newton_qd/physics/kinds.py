"""Kinds of joints, obstacles and smooth steps, for models and kernels."""

import enum


class JointKind(enum.IntEnum):
    """Joint types that the kernels support."""

    FREE = 0
    REVOLUTE = 1
    PRISMATIC = 2


class Tail(enum.IntEnum):
    """How the slope of a smooth step decays far from the step."""

    EXPONENTIAL = 0
    ALGEBRAIC = 1


TAILS = tuple(tail.name.lower() for tail in Tail)
"""Names of the tails, as arguments have them."""


class ObstacleKind(enum.IntEnum):
    """Shapes of obstacles that the kernels support."""

    PLANE = 0
    CAPSULE = 1
    BOX = 2
