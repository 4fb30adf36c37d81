"""The spec of a robot: all data that a URDF file cannot describe.

Masses, inertias, joint frames, limits, damping and colliders are in ``urdf/``. Gears,
the contact material and the time steps are in specs.
"""

from __future__ import annotations

import dataclasses

from newton_qd.checks import message

DEGREE = 3.141592653589793 / 180.0


@dataclasses.dataclass(frozen=True)
class Contact:
    """One sphere of a robot that may touch the scene, or the corners of a box.

    Attributes:
        link: URDF link whose collider carries the sphere.
        end: End of a capsule's axis: ``+1`` or ``-1`` along the local z axis of the
            collider. ``0`` for a sphere, for all eight corners of a box, and for any
            collider of a pair. Boxes touch the ground only.
        collider: Name of the collider in the URDF file; ``None`` if the link has only
            one collider of this kind.
    """

    link: str
    end: int = 0
    collider: str | None = None


@dataclasses.dataclass(frozen=True)
class Material:
    """Softness of contacts and joint limits, relative to the robot.

    Attributes:
        friction: Coulomb coefficient of a pair [-].
        static_penetration: Penetration under the robot's weight at rest on ``support``
            contacts [m]. It sets the stiffness of contacts.
        support: Number of contacts that carry the weight at rest [-].
        smoothing: Half width of the zone in which a contact switches on [m].
        slip_velocity: Velocity below which friction is viscous [m/s].
        dissipation: Hunt-Crossley dissipation [s/m].
        limit_overshoot: Angle past its limit at which a joint is in balance with its
            full gear [rad], of a slide [m]. It sets the stiffness of joint limits.
        limit_swing: Upper bound of the angle past its limit that a joint reaches from
            rest with its full gear alone [rad], of a slide [m]. It has no effect on the
            physics; tests check it.
        limit_dissipation: Hunt-Crossley dissipation of joint limits [s/rad], of a slide
            [s/m].
        limit_smoothing: Half width of the zone in which a limit switches on [rad], of a
            slide [m]. The zone begins at the limit, with torque 0.
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
    limit_dissipation: float = 0.0


@dataclasses.dataclass(frozen=True)
class RobotSpec:
    """A robot: its URDF file, and what the file cannot describe.

    Attributes:
        name: Name of the robot.
        urdf: File name inside ``urdf/``, or a path.
        torso: Link whose position is the robot's position. If it is fixed to another
            link, both must have the same frame.
        feet: Links of the feet-contact descriptor, in order. All contacts of a foot and
            of the links that are fixed to it count.
        actuators: ``(joint, gear)`` in the order of the action. The gear is the torque
            [N m] of an action of 1, or the force [N] for a slide.
        contacts: Spheres that may touch the ground.
        pairs: Pairs of colliders of two links that may touch each other, each with
            ``end`` 0.
        rest_pose: ``(joint, angle)`` of the default pose [rad]; 0 for all other joints.
        rest_height: Height of the torso in the default pose [m]; ``None`` puts
            the lowest contact on the ground. Free bodies that do not hang on the torso
            stay at the origin; ``reset_pose`` can place them.
        rest_rotation: Roll, pitch and yaw of the torso's free root in the default pose
            [rad].
        servos: Joints of ``actuators`` that hold an angle. Their action is the target
            [rad or m]. Their gear is the torque per radian of error [N m/rad], or the
            force per metre [N/m].
        dt: Duration of a control step [s].
        substeps: Physics steps in a control step [-]; ``None``: as many as
            :func:`newton_qd.physics.recommended_substeps` says.
        gravity: Downward acceleration [m/s^2].
        material: Softness of contacts and limits.
        fixed_base: Whether the root link is fixed to the world. ``None``: only a root
            with the name ``world`` is.

    Raises:
        TypeError: ``original_names`` is given; it has moved to
            ``newton_qd.brax_views``.
    """

    name: str
    urdf: str
    torso: str
    feet: tuple[str, ...] = ()
    actuators: tuple[tuple[str, float], ...] = ()
    contacts: tuple[Contact, ...] = ()
    rest_pose: tuple[tuple[str, float], ...] = ()
    dt: float = 0.05
    substeps: int | None = 5
    rest_height: float | None = None
    rest_rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    servos: tuple[str, ...] = ()
    gravity: float = 9.81
    material: Material = Material()
    original_names: dataclasses.InitVar[tuple[()]] = ()  # an error tells the new place
    pairs: tuple[tuple[Contact, Contact], ...] = ()
    fixed_base: bool | None = None

    def __post_init__(self, original_names: tuple[()]) -> None:
        if original_names:
            allowed = (
                "none; names of bodies go to "
                "newton_qd.brax_views.BraxViewsWrapper(env, body_names=...)"
            )
            raise TypeError(message("original_names", original_names, allowed))
