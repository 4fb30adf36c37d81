"""Where a camera stands at first, so that no wall hides the robot."""

from __future__ import annotations

import math

import numpy as np

from newton_qd.physics import reference
from newton_qd.viewing.drawing import Drawing, DrawnShape, body_frames, composed

FIELD = 40.0 * math.pi / 180.0
"""Vertical field of view, as in the pages [rad]."""

_MARGIN = 1.15  # a picture shows a sphere of this many radii of the robot
# of a camera that follows a robot; steep enough that it may also walk to a wall
_SIDE, _RISES = 0.42, (0.45, 2.2, 4.4)
_SIDE_FIXED, _RISE_FIXED = 0.2, 1.1  # a fixed scene is seen from above
_POINTS = 256  # on a line of sight


def camera_offset(
    drawing: Drawing, *, zoom: float = 1.0, elevation: float | None = None
) -> np.ndarray:
    """Returns the vector (3,) from the point that is looked at to the camera [m].

    Args:
        drawing: What is drawn.
        zoom: Size of the robot in a picture [-].
        elevation: Angle of the view above the ground [deg]. ``None``: the smallest of
            some from which no wall hides the robot in its default pose.
    """
    side = _SIDE if drawing.follow else _SIDE_FIXED
    rises = _RISES if drawing.follow else (_RISE_FIXED,)
    if elevation is not None:
        rises = (math.tan(math.radians(elevation)),)
    offsets = [_offset(drawing, side, rise) / zoom for rise in rises]
    seen = (offset for offset in offsets if not _hidden(drawing, offset))
    return next(seen, offsets[0])  # under a roof, no other view is better


def _hidden(drawing: Drawing, offset: np.ndarray) -> bool:
    """Returns whether a wall hides a part of the robot in its default pose."""
    shapes = [shape for shape in drawing.shapes if shape.visual]
    walls = [shape for shape in shapes if shape.body < 0 and shape.color[3] == 1]
    frames = body_frames(drawing, drawing.rest_q)
    parts = [shape for shape in shapes if shape.body >= 0]
    places = [composed(frames[part.body], part.frame)[:3] for part in parts]
    start = np.reshape(places, (-1, 3))
    end = np.array([*frames[drawing.torso, :2], drawing.centre[2]]) + offset
    share = np.linspace(0.0, 1.0, _POINTS)[:, None, None]
    sight = (start + share * (end - start)).reshape(-1, 3)
    return any(bool(_contains(wall, sight).any()) for wall in walls)


def _offset(drawing: Drawing, side: float, rise: float) -> np.ndarray:
    distance = _MARGIN * drawing.radius / math.sin(FIELD / 2)
    away = np.array([-side, -math.sqrt(1 - side * side), rise])
    return distance * away / np.linalg.norm(away)


def _contains(shape: DrawnShape, points: np.ndarray) -> np.ndarray:
    """Returns which points (n, 3) of the world are inside a shape of the world.

    Meshes count as empty.
    """
    back = reference.inverse(shape.frame)
    here = points @ reference.rotation_matrix(back[3:]).T + back[:3]
    if shape.kind == "mesh":
        return np.zeros(len(here), bool)
    if shape.kind == "box":
        return np.all(np.abs(here) <= shape.size, axis=1)
    radius, half = shape.size[0], 0.0 if shape.kind == "sphere" else shape.size[1]
    beyond = np.maximum(np.abs(here[:, 2]) - half, 0.0)
    across = np.hypot(here[:, 0], here[:, 1])
    if shape.kind == "cylinder":
        return (across <= radius) & (beyond == 0.0)
    return np.hypot(across, beyond) <= radius
