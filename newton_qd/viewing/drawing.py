"""What is drawn of an environment: its kinematic tree and its shapes.

Shapes are those that Newton reads from the URDF files of the robot and the scene. The
tree is that of the ``System``. So a picture shows what the physics computes.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from newton_qd.assets import find_urdf
from newton_qd.checks import Fact, message
from newton_qd.envs.base import Env, PhysicsEnv
from newton_qd.envs.pointmaze import PointMaze
from newton_qd.physics import reference
from newton_qd.physics.kinds import JointKind
from newton_qd.physics.model import newton_builder
from newton_qd.physics.model.description import read_description
from newton_qd.physics.system import System
from newton_qd.viewing.kept_shapes import kept_or_read

if TYPE_CHECKING:
    import newton

_POINT, _WALL, _GOAL = (0.85, 0.35, 0.1), (0.25, 0.32, 0.42), (0.2, 0.65, 0.3)
_POINT_RADIUS = 0.03  # of the point of a maze, which has no size of its own
_SMALL = 0.6  # largest radius of a robot on a fine grid [m]
_IDENTITY = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


@dataclasses.dataclass(frozen=True, eq=False)
class DrawnShape:
    """A shape on a body.

    Attributes:
        body: Index of the body, -1 for the world.
        kind: ``"sphere"``, ``"capsule"``, ``"cylinder"``, ``"box"`` or ``"mesh"``.
        frame: (7,) position [m] and quaternion xyzw in the body.
        size: (3,) sphere: radius; capsule and cylinder, along local z: radius, half
            length of the straight part; box: half extents [m]; mesh: scale [-].
        color: (4,) red, green, blue and opacity, 0 to 1, sRGB.
        visual: Whether it is drawn by default. The others are colliders of a body that
            has visuals.
        vertices: (n, 3) vertices of a mesh [m], empty otherwise.
        faces: (m, 3) indices of the corners of its triangles.
    """

    body: int
    kind: str
    frame: np.ndarray
    size: np.ndarray
    color: tuple[float, float, float, float]
    visual: bool = True
    vertices: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    faces: np.ndarray = dataclasses.field(
        default_factory=lambda: np.zeros((0, 3), np.int32)
    )

    @property
    def reach(self) -> float:
        """Largest distance of a point of the shape from its centre [m]."""
        if self.kind == "sphere":
            return float(self.size[0])
        if self.kind in ("capsule", "cylinder"):
            return float(self.size[0] + self.size[1])
        if self.kind == "mesh":
            points = self.vertices * self.size
            return float(np.linalg.norm(points, axis=1).max(initial=0.0))
        return float(np.linalg.norm(self.size))


@dataclasses.dataclass(frozen=True, eq=False)
class Drawing:
    """A kinematic tree with shapes.

    The arrays of the tree are those of :class:`~newton_qd.physics.system.System`.

    Attributes:
        name: Name of the robot or of the task.
        body_names: (nb,) names of the bodies.
        feet: Names of the feet.
        parent: (nb,) parent body, -1 for the world.
        joint_kind: (nb,) see :class:`~newton_qd.physics.kinds.JointKind`.
        q_start: (nb,) index of a joint's first coordinate.
        joint_axis: (nb, 3) axis in the joint frame [-].
        parent_frame: (nb, 7) joint frame in the parent body.
        child_frame: (nb, 7) joint frame in the child body.
        nq: Number of coordinates.
        torso: Body that a camera follows.
        shapes: All shapes.
        centre: (3,) point that a camera looks at before it follows [m].
        radius: Radius of the sphere around it that a picture shows [m].
        follow: Whether a camera follows the torso by default.
        rest_q: (nq,) coordinates of the default pose.
    """

    name: str
    body_names: tuple[str, ...]
    feet: tuple[str, ...]
    parent: np.ndarray
    joint_kind: np.ndarray
    q_start: np.ndarray
    joint_axis: np.ndarray
    parent_frame: np.ndarray
    child_frame: np.ndarray
    nq: int
    torso: int
    shapes: tuple[DrawnShape, ...]
    centre: np.ndarray
    radius: float
    follow: bool
    rest_q: np.ndarray

    @property
    def grid(self) -> float:
        """Distance of the lines on the ground [m]."""
        return 1.0 if self.radius > _SMALL else 0.1

    def shows(self, other: Drawing) -> bool:
        """Whether another robot and its scene look the same; colours may differ."""

        def seen(drawing: Drawing) -> tuple:
            shapes = [
                (x.body, x.kind, x.frame.tolist(), x.size.tolist())
                for x in drawing.shapes
            ]
            return drawing.body_names, sorted(shapes)

        return seen(self) == seen(other)


def body_frames(drawing: Drawing, q: np.ndarray) -> np.ndarray:
    """Returns the world frames of the bodies.

    Args:
        drawing: The kinematic tree.
        q: (..., nq) coordinates [m or rad].

    Returns:
        (..., nb, 7) positions [m] and quaternions xyzw.
    """
    q = np.asarray(q, np.float64)
    shape = q.shape[:-1]
    frames = np.empty((*shape, len(drawing.parent), 7))
    for body, parent in enumerate(drawing.parent):
        start, axis = drawing.q_start[body], drawing.joint_axis[body]
        motion = np.zeros((*shape, 7))
        motion[..., 6] = 1.0
        kind = drawing.joint_kind[body]
        if kind == JointKind.FREE:
            motion[:] = q[..., start : start + 7]
            motion[..., 3:] /= np.linalg.norm(motion[..., 3:], axis=-1, keepdims=True)
        elif kind == JointKind.REVOLUTE:
            half = q[..., start, None] / 2
            motion[..., 3:6], motion[..., 6:] = np.sin(half) * axis, np.cos(half)
        else:
            motion[..., :3] = q[..., start, None] * axis
        frame = composed(drawing.parent_frame[body], motion)
        if parent >= 0:
            frame = composed(frames[..., parent, :], frame)
        back = reference.inverse(drawing.child_frame[body])
        frames[..., body, :] = composed(frame, back)
    return frames


def composed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns frames ``b`` (..., 7), given in frames ``a`` (..., 7), in their frame."""
    axis, w = a[..., 3:6], a[..., 6:]
    other, v = b[..., 3:6], b[..., 6:]
    turned = 2.0 * np.cross(axis, b[..., :3])
    position = a[..., :3] + b[..., :3] + w * turned + np.cross(axis, turned)
    vector = w * other + v * axis + np.cross(axis, other)
    scalar = w * v - (axis * other).sum(axis=-1, keepdims=True)
    return np.concatenate([position, vector, scalar], axis=-1)


def can_draw(env: object) -> bool:
    """Returns whether an environment can be drawn."""
    return isinstance(getattr(env, "unwrapped", None), (PhysicsEnv, PointMaze))


def drawing_of(env: Env) -> Drawing:
    """Returns what is drawn of an environment.

    Args:
        env: A simulated robot or ``pointmaze``, with or without wrappers.

    Raises:
        TypeError: The environment is neither.
        RobotDescriptionError: A URDF file is malformed.
        OSError: A URDF file cannot be read.
    """
    base = getattr(env, "unwrapped", None)
    if isinstance(base, PhysicsEnv):
        return drawing_of_system(base.system)
    if isinstance(base, PointMaze):
        return _maze(base)
    allowed = "environments whose unwrapped is a PhysicsEnv, or pointmaze"
    raise TypeError(message("env", Fact(type(env).__name__), allowed))


def drawing_of_system(system: System) -> Drawing:
    """Returns what is drawn of a robot and its scene.

    Raises:
        RobotDescriptionError: A URDF file is malformed.
        OSError: A URDF file cannot be read.
    """
    shapes = tuple(_shapes(system))
    centre, radius = _bounds(system, shapes)
    return Drawing(
        name=system.robot.name,
        body_names=system.body_names,
        feet=tuple(system.robot.feet),
        parent=system.parent,
        joint_kind=system.joint_kind,
        q_start=system.q_start,
        joint_axis=system.joint_axis,
        parent_frame=system.parent_frame,
        child_frame=system.child_frame,
        nq=system.nq,
        torso=system.torso,
        shapes=shapes,
        centre=centre,
        radius=radius,
        follow=_travels(system),
        rest_q=system.rest_q,
    )


def _travels(system: System) -> bool:
    """Returns whether the robot can leave its place.

    Then its torso floats or slides, and something that is driven moves with it. The
    torso of an arm may be an object that it pushes.
    """
    roots, driven = system.roots, np.isin(system.v_start, system.control_dof)
    if roots[system.torso] not in roots[driven]:
        return False
    body, kinds = system.torso, set()
    while body >= 0:
        kinds.add(int(system.joint_kind[body]))
        body = int(system.parent[body])
    return kinds != {int(JointKind.REVOLUTE)}


def _bounds(system: System, shapes: tuple[DrawnShape, ...]) -> tuple[np.ndarray, float]:
    """Returns centre (3,) and radius [m] of the robot in its default pose."""
    frames = reference.body_frames(system, system.rest_q)
    moving = [shape for shape in shapes if shape.body >= 0 and shape.visual]
    places = [
        reference.compose(frames[shape.body], np.asarray(shape.frame, float))[:3]
        for shape in moving
    ]
    if not places:
        return frames[:, :3].mean(axis=0), 1.0
    reaches = np.array([shape.reach for shape in moving])[:, None]
    low = (np.array(places) - reaches).min(axis=0)
    high = (np.array(places) + reaches).max(axis=0)
    return (low + high) / 2, float(np.linalg.norm(high - low) / 2)


def _files(system: System) -> list[tuple[str, bool]]:
    """Returns the URDF files of a system, and whether their root links float."""
    robot = system.robot
    read = read_description(find_urdf(robot.urdf), robot.fixed_base)
    files = [(robot.urdf, read.floating)]
    if system.scene is not None:
        files.append((system.scene.urdf, False))
    return [(str(find_urdf(urdf)), floats) for urdf, floats in files]


def _builder(system: System, path: str, floats: bool) -> newton.ModelBuilder:
    return newton_builder(path, floats, system.robot.gravity, drawn=True)


def _shapes(system: System) -> Iterator[DrawnShape]:
    """Yields the shapes of the robot, then those of the scene."""
    for path, floats in _files(system):
        build = functools.partial(_builder, system, path, floats)
        for row in kept_or_read(Path(path), floats, build):
            body, kind, frame, size, color, visual, *points = row
            mesh = dict(zip(("vertices", "faces"), points, strict=False))
            yield DrawnShape(
                body=body,
                kind=kind,
                frame=np.array(frame, np.float64),
                size=np.array(size, np.float64),
                color=tuple(color),
                visual=visual,
                **mesh,
            )


def _maze(env: PointMaze) -> Drawing:
    """Returns what is drawn of the point maze. Its lengths have no unit."""
    ends = np.array([env.descriptors_min_values, env.descriptors_max_values])
    centre, half = ends.mean(axis=0), (ends[1] - ends[0]) / 2
    thickness = min(wall[3] - wall[1] for wall in env.walls)
    shapes = [
        DrawnShape(
            1, "sphere", _IDENTITY, np.array([_POINT_RADIUS, 0, 0]), (*_POINT, 1)
        )
    ]
    boxes = [(np.array(wall), _WALL) for wall in env.walls]
    for axis, side in itertools.product((0, 1), (-1, 1)):
        middle, size = centre.copy(), half + thickness
        middle[axis] += side * (half[axis] + thickness / 2)
        size[axis] = thickness / 2
        boxes.append((np.concatenate([middle - size, middle + size]), _WALL))
    for corners, color in boxes:
        low, high = corners[:2], corners[2:]
        frame = _IDENTITY.copy()
        frame[:3] = [*(low + high) / 2, _POINT_RADIUS]
        size = np.array([*(high - low) / 2, _POINT_RADIUS])
        shapes.append(DrawnShape(-1, "box", frame, size, (*color, 1)))
    goal, zone = _IDENTITY.copy(), env.zone_width / 2
    goal[:2] = env.goal
    # thinner than the walls, so that the point is seen in it
    size = np.array([zone, zone, _POINT_RADIUS / 10])
    shapes.append(DrawnShape(-1, "box", goal, size, (*_GOAL, 0.8)))
    lift = _IDENTITY.copy()
    lift[2] = _POINT_RADIUS
    return Drawing(
        name=env.name,
        body_names=("x", "point"),
        feet=(),
        parent=np.array([-1, 0], np.int32),
        joint_kind=np.array([JointKind.PRISMATIC] * 2, np.int32),
        q_start=np.array([0, 1], np.int32),
        joint_axis=np.eye(3)[:2],
        parent_frame=np.stack([lift, _IDENTITY]),
        child_frame=np.stack([_IDENTITY, _IDENTITY]),
        nq=2,
        torso=1,
        shapes=tuple(shapes),
        centre=np.array([*centre, 0.0]),
        radius=float(np.linalg.norm(half)),
        follow=False,
        rest_q=np.zeros(2),
    )
