"""What a robot's spec holds: everything about a robot that its URDF file cannot.

Masses, inertias, joint frames, limits, damping and colliders are in ``urdf/``;
gears, the contact material and the time steps are in specs of this type.
"""

from __future__ import annotations

import dataclasses

from newton_qd.checks import message

DEGREE = 3.141592653589793 / 180.0


@dataclasses.dataclass(frozen=True)
class Contact:
    """One sphere of a robot that may touch the scene.

    Attributes:
        link: URDF link whose collider carries the sphere.
        end: Which end of a capsule's axis: ``+1`` or ``-1`` along the local z
            axis of the collider; ``0`` for a sphere, and in a pair.
        collider: Name of the collider in the URDF file; ``None`` where the link has
            only one of its kind.
    """

    link: str
    end: int = 0
    collider: str | None = None


@dataclasses.dataclass(frozen=True)
class Material:
    """Contact and joint-limit softness, scaled to the robot.

    Attributes:
        friction: Coulomb coefficient of a pair [-].
        static_penetration: Penetration that the robot's weight causes when it
            rests on ``support`` contacts [m]; sets the stiffness.
        support: Number of contacts that carry the weight at rest [-].
        smoothing: Half width of the zone in which a contact switches on [m].
        slip_velocity: Velocity below which friction is viscous [m/s].
        dissipation: Hunt-Crossley dissipation [s/m].
        limit_overshoot: Angle by which a joint's full gear holds it past its limit
            [rad]; sets the stiffness of the limits.
        limit_swing: Angle past its limit that a joint does not reach when its full
            gear alone swings it there from rest [rad]; a promise, it sets nothing.
        limit_smoothing: Half width of the zone in which a limit switches on
            [rad]; the zone begins at the limit, where nothing is felt yet.
    """

    friction: float = 1.0
    static_penetration: float = 0.003
    support: int = 4
    smoothing: float = 0.02
    slip_velocity: float = 0.1
    dissipation: float = 0.5
    limit_overshoot: float = 0.1
    limit_swing: float = 0.25
    limit_smoothing: float = 0.05


@dataclasses.dataclass(frozen=True)
class RobotSpec:
    """One robot of the suite.

    Attributes:
        name: Name of the robot.
        urdf: File name inside ``urdf/``, or a path.
        torso: Link whose position is the robot's position.
        feet: Links whose contacts make the feet-contact descriptor, in order.
        actuators: ``(joint, gear)`` in the order of the action; gear is the
            torque of a unit action [N m], or the force of a slide [N].
        contacts: Spheres that may touch the ground.
        pairs: Whole colliders, each with ``end`` 0, of two links that may touch each
            other.
        rest_pose: ``(joint, angle)`` of the default pose [rad]; joints that
            are not named rest at 0.
        rest_height: Height of the root in the default pose [m]; ``None`` puts
            the lowest contact on the ground.
        rest_rotation: Roll, pitch and yaw of a free root in the default pose [rad].
        servos: Those joints of ``actuators`` that hold an angle: the action is the
            target [rad or m] and gear the torque for each radian off it [N m/rad],
            or the force for each metre [N/m].
        dt: Duration of a control step [s].
        substeps: Physics steps in a control step [-].
        gravity: Downward acceleration [m/s^2].
        material: Softness of contacts and limits.
    """

    name: str
    urdf: str
    torso: str
    feet: tuple[str, ...] = ()
    actuators: tuple[tuple[str, float], ...] = ()
    contacts: tuple[Contact, ...] = ()
    rest_pose: tuple[tuple[str, float], ...] = ()
    dt: float = 0.05
    substeps: int = 5
    rest_height: float | None = None
    rest_rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    servos: tuple[str, ...] = ()
    gravity: float = 9.81
    material: Material = Material()
    original_names: dataclasses.InitVar[tuple[()]] = ()  # where it has gone is said
    pairs: tuple[tuple[Contact, Contact], ...] = ()

    def __post_init__(self, original_names: tuple[()]) -> None:
        if original_names:
            allowed = (
                "none; names of bodies go to "
                "newton_qd.brax_views.BraxViewsWrapper(env, body_names=...)"
            )
            raise TypeError(message("original_names", original_names, allowed))
