"""The immutable description of one robot in one scene, and the physics state."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from newton_qd.checks import Fact, message
from newton_qd.physics.kinds import JointKind as JointKind
from newton_qd.physics.kinds import ObstacleKind as ObstacleKind
from newton_qd.robots import RobotSpec
from newton_qd.scenes import Scene

CONTACT_FRACTION = 0.01
"""Share of the robot's weight above which a foot touches the ground [-]."""
STANDARD_GRAVITY = 9.81
"""Gives a robot without gravity the weight that its feet are measured by [m/s^2]."""


@dataclasses.dataclass(frozen=True, eq=False)
class System:
    """One world: the kinematic tree, its material and its scene.

    All arrays are float64 or int32 NumPy arrays, read-only; the kernels read a
    copy in the precision ``dtype``. Systems compare and hash by identity.
    Bodies are ordered parents first; joint ``i`` connects body ``i`` to its
    parent. Quaternions are (x, y, z, w) here and in the kernels, and in ``q``.

    Attributes:
        robot: The row that the system was built from.
        scene: The row of what stands on the ground; ``None``: nothing.
        dtype: ``"float32"`` or ``"float64"``: precision of the kernels.
        body_names: (nb,) URDF link names.
        joint_names: (nb,) URDF joint names; the root's is the empty string when
            Newton made the joint.
        parent: (nb,) parent body, -1 for the world.
        joint_kind: (nb,) see :class:`JointKind`.
        q_start: (nb,) first coordinate of a joint in ``q``.
        v_start: (nb,) first degree of freedom of a joint in ``v``.
        joint_axis: (nb, 3) axis in the joint frame [-].
        parent_frame: (nb, 7) joint frame in the parent body, position [m] and
            quaternion.
        child_frame: (nb, 7) joint frame in the child body, position [m] and
            quaternion.
        mass: (nb,) [kg].
        com: (nb, 3) centre of mass in the body frame [m].
        inertia: (nb, 3, 3) about the centre of mass, body axes [kg m^2].
        armature: (nv,) rotor inertia [kg m^2 or kg].
        damping: (nv,) viscous joint damping [N m s/rad or N s/m].
        stiffness: (nv,) joint spring [N m/rad or N/m].
        spring_rest: (nv,) rest angle of the joint spring [rad or m].
        limit_lower: (nv,) [rad or m]; -inf where there is none.
        limit_upper: (nv,) [rad or m]; +inf where there is none.
        limit_stiffness: (nv,) [N m/rad or N/m]; 0 where there is no limit.
        control_dof: (nu,) degree of freedom that each action drives.
        gear: (nu,) generalized force of a unit action [N m or N].
        contact_body: (nc,) body of each contact sphere or capsule, ascending.
        contact_position: (nc, 3) centre in the body frame [m].
        contact_segment: (nc, 3) from the centre to an end of a capsule's axis in
            the body frame [m]; zero for a sphere, and not read for the ground.
        contact_radius: (nc,) [m].
        contact_obstacle: (nc,) row of the obstacle tables; -1 for a side of a pair.
        contact_pairs: (np, 2) rows of the two sides of each pair of colliders, on
            two bodies, that may touch each other.
        contact_pair_share: (np,) how much of a pair's relative motion an impulse
            gives to its first side, between 0 and 1 [-].
        obstacle_kind: (no,) see :class:`ObstacleKind`.
        obstacle_frame: (no, 7) world pose; a plane's normal and a capsule's
            axis are the local z axis.
        obstacle_size: (no, 3) capsule: radius, half length, 0; box: half
            extents [m]; plane: zeros.
        scene_links: (ns,) names of the links that never move: those of the robot
            that are fixed to the world, then the scene's.
        scene_frames: (ns, 7) their frames in the world.
        contact_stiffness: [N/m].
        feet: (nf,) body index of each foot.
        feet_width: Share of the robot's weight over which the smooth contact of a
            foot rises [-].
        reports_bodies: Whether a step reports where the bodies are.
        torso: Body index of the torso.
        rest_q: (nq,) coordinates of the default pose, ``v`` being 0.

    Raises:
        ValueError: A contact table has another length than ``contact_body``.
    """

    robot: RobotSpec
    scene: Scene | None
    dtype: str
    body_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    parent: np.ndarray
    joint_kind: np.ndarray
    q_start: np.ndarray
    v_start: np.ndarray
    joint_axis: np.ndarray
    parent_frame: np.ndarray
    child_frame: np.ndarray
    mass: np.ndarray
    com: np.ndarray
    inertia: np.ndarray
    armature: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    spring_rest: np.ndarray
    limit_lower: np.ndarray
    limit_upper: np.ndarray
    limit_stiffness: np.ndarray
    control_dof: np.ndarray
    gear: np.ndarray
    contact_body: np.ndarray
    contact_position: np.ndarray
    contact_segment: np.ndarray
    contact_radius: np.ndarray
    contact_obstacle: np.ndarray
    contact_pairs: np.ndarray
    contact_pair_share: np.ndarray
    obstacle_kind: np.ndarray
    obstacle_frame: np.ndarray
    obstacle_size: np.ndarray
    scene_links: tuple[str, ...]
    scene_frames: np.ndarray
    contact_stiffness: float
    feet: np.ndarray
    torso: int
    rest_q: np.ndarray
    feet_width: float
    reports_bodies: bool

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
        for field in ("position", "segment", "radius", "obstacle"):
            # the kernels read these tables without looking at their length
            rows = len(getattr(self, f"contact_{field}"))
            if rows != len(self.contact_body):
                allowed = f"{len(self.contact_body)}, as many as contact_body has"
                given = Fact(f"{rows} rows")
                raise ValueError(message(f"contact_{field}", given, allowed))

    @property
    def nb(self) -> int:
        """Number of bodies."""
        return len(self.parent)

    @property
    def nq(self) -> int:
        """Number of coordinates."""
        return len(self.rest_q)

    @property
    def nv(self) -> int:
        """Number of degrees of freedom."""
        return len(self.damping)

    @property
    def nu(self) -> int:
        """Number of actions."""
        return len(self.gear)

    @property
    def torso_floats(self) -> bool:
        """Whether the torso moves freely, so that its position is in ``q``."""
        return self.joint_kind[self.torso] == JointKind.FREE

    @property
    def has_boxes(self) -> bool:
        """Whether an obstacle is a box, for which the kernels have more to do."""
        return bool(np.any(self.obstacle_kind == ObstacleKind.BOX))

    @property
    def ground_contacts(self) -> np.ndarray:
        """Rows of the contact tables that touch the ground, obstacle 0."""
        return np.flatnonzero(self.contact_obstacle == 0)

    @property
    def total_mass(self) -> float:
        """Mass of the robot [kg]."""
        return float(self.mass.sum())


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Kinematics:
    """Where the bodies are and how they move, world axes.

    Attributes:
        position: (nb, 3) origin of the link frame [m].
        rotation: (nb, 4) quaternion xyzw of the link frame.
        com: (nb, 3) centre of mass [m].
        linear_velocity: (nb, 3) of the centre of mass [m/s].
        angular_velocity: (nb, 3) [rad/s].
    """

    position: jax.Array
    rotation: jax.Array
    com: jax.Array
    linear_velocity: jax.Array
    angular_velocity: jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PhysicsState:
    """State of a world, and what is read from it.

    A step starts from ``q`` and ``v`` alone and writes all the rest: for a state of
    other coordinates call :func:`~newton_qd.physics.initial_state`.

    A free root has coordinates (position of the root origin, quaternion xyzw)
    and velocities (linear velocity of the root origin, angular velocity), all
    in world axes.

    Attributes:
        q: (nq,) coordinates [m or rad].
        v: (nv,) velocities [m/s or rad/s].
        impulse: (nb, 6) contact impulse on each body over the control step,
            friction included: linear [N s], then angular about the body's
            centre of mass [N m s], world axes.
        normal_impulse: (nb,) sum of the normal contact impulses on each body
            over the control step [N s]; never negative.
        feet_contact: (nf,) 1 where a foot carried more than 1 % of the robot's
            weight over the control step, else 0; its gradient is 0.
        smooth_feet_contact: (nf,) the same as a smooth step of the system's
            ``feet_width``, 0.5 where the other switches.
        torso_xy: (2,) x and y of the torso's link frame [m].
        bodies: Where the bodies are and how they move; ``None`` where the system does
            not report it.
    """

    q: jax.Array
    v: jax.Array
    impulse: jax.Array
    normal_impulse: jax.Array
    feet_contact: jax.Array
    smooth_feet_contact: jax.Array
    torso_xy: jax.Array
    bodies: Kinematics | None = None
