"""The speed up to which the walls of a scene hold a robot."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from newton_qd.checks import Fact, message
from newton_qd.physics import reference
from newton_qd.physics.model.substeps import contact_masses, iterates
from newton_qd.physics.system import ObstacleKind, System, takes_system
from newton_qd.robots import RobotSpec

# Speeds that are tried [m/s]. Beyond them, sliding along a wall is no longer tested.
_SPEEDS = np.geomspace(0.01, 100.0, 1000)
# Slower bodies have stopped, or rest on the wall [m/s].
_STOPPED = 0.001
# Where the surface may be at the start of a substep, in paths of one substep.
_PHASES = np.linspace(0.0, 1.0, 8, endpoint=False)
# The middle of a box is closer to its surface, by this share of the contact smoothing:
# the largest difference that two of the kernels' rounded corners make.
_ROUNDED_BOX = 0.375
# The nearest points of two capsules are further apart, by this share of the smoothing.
_ROUNDED_CAPSULE = 0.3


# Slower walls get a warning [m/s]. The walls of the suite hold more.
_EXPECTED = 10.0


class SoftWallWarning(UserWarning):
    """A wall does not hold a robot that moves at 10 m/s."""


def soft_walls(system: System) -> tuple[str, ...]:
    """Returns a text about each wall that does not hold the robot at 10 m/s.

    The speed is that of the link which the wall holds best: the other links of its tree
    stay with this one. Of several trees, such as a robot and a ball, the one that is
    held worst counts.

    Args:
        system: The system.
    """
    if system.scene is None or system.scene.links == ():  # it touches nothing
        return ()
    speeds, texts = wall_speeds(system), []
    trees = system.roots[system.contact_body]
    for wall in range(1, len(system.obstacle_kind)):
        own = system.contact_obstacle == wall
        held = {
            int(tree): speeds[own & (trees == tree)].max()
            for tree in np.unique(trees[own])
        }
        tree = min(held, key=lambda tree: held[tree], default=None)
        speed = 0.0 if tree is None else held[tree]
        if speed < _EXPECTED:
            name = f"scene {system.scene.name!r}, wall {wall}"
            moving = system.robot.name
            if len(held) > 1 and tree is not None:
                moving += f", the body on {system.body_names[tree]!r},"
            given = Fact(f"{moving} is held up to {speed:.2g} m/s")
            allowed = (
                f"{_EXPECTED:g} m/s, with a thicker wall or a smaller "
                "Material.static_penetration; a faster robot passes through "
                "(newton_qd.physics.wall_speeds)"
            )
            texts.append(message(name, given, allowed))
    return tuple(texts)


@takes_system
def wall_speeds(system: System) -> np.ndarray:
    """Computes the speed up to which each contact with a wall holds the robot.

    A contact is soft, so a fast body presses itself deep into a wall. If its centre
    passes the middle of the wall, it is pushed out on the other side. The middle is
    that of a box, or the axis of a capsule. Below the returned speed, this does not
    happen. A small body on the ground can also be squeezed through under a round wall.

    The whole robot moves with this speed, and this contact alone stops it. Motors do
    not push. The physical parameters are those of the system.

    Args:
        system: The system.

    Returns:
        (nc,) largest speed for each row of the system's contact tables, up to 100
        [m/s]. It is infinite for contacts with the ground and of pairs.
    """
    speeds = np.full(len(system.contact_body), np.inf)
    known: dict[_Way, float] = {}
    follows = iterates(system)
    masses = _moved_masses(system)
    for c in np.flatnonzero(system.contact_obstacle > 0):
        stiffness = system.contact_stiffness / float(masses[c])
        for way in _ways_through(system, int(c), stiffness):
            if way not in known:
                known[way] = _largest_speed(way, system.h, follows)
            speeds[c] = min(speeds[c], known[way])
            if system.contact_segment[c].any():
                # One end of a capsule touches. The other end must not cross the wall
                # within a substep.
                speeds[c] = min(speeds[c], way.depth / system.h)
    return speeds


@dataclasses.dataclass(frozen=True)
class _Way:
    """A way of a body through a wall.

    Attributes:
        depth: Depth at which the body is through [m].
        stiffness: Stiffness of what resists, over the mass [1/s^2].
        dissipation: Hunt-Crossley dissipation, for the velocity along the way [s/m].
        pull: Gravity along the way [m/s^2].
    """

    depth: float
    stiffness: float
    dissipation: float
    pull: float


def _moved_masses(system: System) -> np.ndarray:
    """Returns the mass (nc,) that each contact has to stop [kg].

    It is the mass of the robot. A collider near the hinge of an arm has to stop more.
    """
    masses = np.full(len(system.contact_body), system.total_mass)
    return masses if system.torso_floats else np.maximum(masses, contact_masses(system))


def _ways_through(system: System, c: int, stiffness: float) -> list[_Way]:
    """Returns the ways through the wall of a contact."""
    obstacle = system.contact_obstacle[c]
    frame, size = system.obstacle_frame[obstacle], system.obstacle_size[obstacle]
    radius = float(system.contact_radius[c])
    material, gravity = system.robot.material, system.robot.gravity
    up = reference.rotation_matrix(frame[3:])[2]  # share of each axis of the wall
    if system.obstacle_kind[obstacle] == ObstacleKind.BOX:
        rounded = _ROUNDED_BOX * material.smoothing
        return [
            _Way(
                depth=max(half + radius - rounded, 0.0),
                stiffness=stiffness,
                dissipation=material.dissipation,
                pull=gravity * abs(share),
            )
            for half, share in zip(size.tolist(), up.tolist(), strict=True)
        ]
    flat = not system.contact_segment[c].any()
    rounded = 0.0 if flat else _ROUNDED_CAPSULE * material.smoothing
    depth = max(float(size[0]) + radius - rounded, 0.0)
    across = gravity * math.sqrt(max(0.0, 1.0 - float(up[2]) ** 2))
    ways = [_Way(depth, stiffness, material.dissipation, across)]
    lowest = float(frame[2] - abs(up[2]) * size[1] - size[0])
    squeezed = 2.0 * radius - max(lowest, 0.0) - rounded
    body = system.contact_body[c]
    if squeezed > 0.0 and body in system.contact_body[system.ground_contacts]:
        ways.append(_under(squeezed, depth, stiffness, system.robot))
    return ways


def _under(squeezed: float, depth: float, stiffness: float, robot: RobotSpec) -> _Way:
    """Returns the way between the ground and a round wall.

    Ground and wall are two springs in a row. Friction resists at one of them, while the
    body rolls on the other one. Over the way x, they are compressed by about
    squeezed (1 - (x / length)^2), so the mean is two thirds.

    Args:
        squeezed: Compression under the axis of the wall [m].
        depth: Distance of axis and centre where the surfaces touch [m].
        stiffness: Stiffness of a contact, over the mass [1/s^2].
        robot: The robot.
    """
    material = robot.material
    length = math.sqrt(max(depth**2 - (depth - squeezed) ** 2, 0.0))
    slope = squeezed / length
    resistance = 1.0 + 4.0 / 3.0 * material.friction / slope
    # The body sinks into the ground by half of the compression, and approaches each of
    # the two surfaces with half of slope times the velocity.
    return _Way(
        depth=squeezed,
        stiffness=0.5 * stiffness * resistance,
        dissipation=0.5 * slope * material.dissipation,
        pull=0.5 * robot.gravity,
    )


def _slower(
    x: np.ndarray, v: np.ndarray, way: _Way, h: float, follows: bool
) -> np.ndarray:
    """Returns the change of velocity (...) of point masses in a substep [m/s].

    The contact law is that of the kernels on a line, without its clip, which adds to
    the impulse. One iteration has the damping factor of the velocity at the start, and
    gives the impulse that it found. Several are two steps of Newton's method on the law
    with the damping factor of the new velocity.

    Args:
        x: (...) depths at the start [m].
        v: (...) velocities at the start, inwards [m/s].
        way: The way.
        h: Substep [s].
        follows: Whether the damping factor follows the velocity: several iterations.
    """
    change = np.zeros(v.shape)
    for _ in range(2 if follows else 1):
        new = v + change
        depth = np.maximum(x + h * new, 0.0)
        damper = h * way.stiffness * np.maximum(1.0 + way.dissipation * new, 0.0)
        slope = np.where(depth > 0.0, h * damper, 0.0)
        if follows:
            slope += h * way.stiffness * way.dissipation * depth * (damper > 0.0)
        law = damper * depth
        change = (h * way.pull - law + slope * change) / (1.0 + slope)
    return change


def _largest_speed(way: _Way, h: float, follows: bool) -> float:
    """Returns the largest speed below which no point mass gets through [m/s].

    Substeps begin at all distances from the surface.

    Args:
        way: The way.
        h: Substep [s].
        follows: Whether the damping factor follows the velocity.
    """
    v = np.repeat(_SPEEDS[:, None], len(_PHASES), axis=1)
    x = -_PHASES * h * v
    through = np.zeros(v.shape, bool)
    moving = np.ones(v.shape, bool)
    while moving.any():
        v = np.where(moving, v + _slower(x, v, way, h, follows), v)
        x = np.where(moving, x + h * v, x)
        through |= x >= way.depth
        moving &= (v > _STOPPED) & ~through
    passed = through.any(axis=1)
    if not passed.any():
        return float(_SPEEDS[-1])
    first = int(np.argmax(passed))
    return float(_SPEEDS[first - 1]) if first else 0.0
