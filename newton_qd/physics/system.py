"""The immutable description of one robot in one scene, and the physics state."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Concatenate, ParamSpec, TypeVar

import jax
import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.physics.kinds import TAILS as TAILS
from newton_qd.physics.kinds import JointKind as JointKind
from newton_qd.physics.kinds import ObstacleKind as ObstacleKind
from newton_qd.robots import RobotSpec
from newton_qd.scenes import Scene

CONTACT_FRACTION = 0.01
"""Minimum load of a foot that counts as contact, as a share of the weight [-]."""
STANDARD_GRAVITY = 9.81
"""Gravity that defines the weight of a robot whose own gravity is 0 [m/s^2].

The contacts of its feet are measured relative to this weight.
"""


@dataclasses.dataclass(frozen=True, eq=False)
class System:
    """Description of one world: the kinematic tree, its material and its scene.

    All arrays are read-only NumPy arrays, float64 or int32. The kernels read a copy in
    the precision ``dtype``. Systems compare and hash by identity. A parent body comes
    before its children. Joint ``i`` connects body ``i`` to its parent. Quaternions are
    (x, y, z, w) here, in the kernels and in ``q``.

    Attributes:
        robot: The robot that the system was built from.
        scene: The scene with the obstacles. ``None``: only the ground.
        dtype: Precision of the kernels: ``"float32"`` or ``"float64"``.
        body_names: (nb,) URDF link names.
        joint_names: (nb,) URDF joint names. The name is empty for a root joint that
            Newton added.
        parent: (nb,) parent body, -1 for the world.
        joint_kind: (nb,) see :class:`JointKind`.
        q_start: (nb,) index of a joint's first coordinate in ``q``.
        v_start: (nb,) index of a joint's first degree of freedom in ``v``.
        joint_axis: (nb, 3) axis in the joint frame [-].
        parent_frame: (nb, 7) joint frame in the parent body, position [m] and
            quaternion.
        child_frame: (nb, 7) joint frame in the child body, position [m] and
            quaternion.
        mass: (nb,) mass [kg].
        com: (nb, 3) centre of mass in the body frame [m].
        inertia: (nb, 3, 3) inertia about the centre of mass, body axes [kg m^2].
        armature: (nv,) rotor inertia [kg m^2 or kg].
        damping: (nv,) viscous joint damping [N m s/rad or N s/m].
        stiffness: (nv,) joint spring [N m/rad or N/m].
        spring_rest: (nv,) rest angle of the joint spring [rad or m].
        limit_lower: (nv,) lower limit [rad or m], -inf without a limit.
        limit_upper: (nv,) upper limit [rad or m], +inf without a limit.
        limit_stiffness: (nv,) stiffness of the limits [N m/rad or N/m], 0 without a
            limit.
        control_dof: (nu,) degree of freedom that each action drives.
        gear: (nu,) generalized force of a unit action [N m or N].
        contact_body: (nc,) body of each contact sphere or capsule, ascending.
        contact_position: (nc, 3) centre in the body frame [m].
        contact_segment: (nc, 3) vector from the centre to an end of a capsule's axis
            in the body frame [m]. Zero for a sphere. Not read for the ground.
        contact_radius: (nc,) radius [m].
        contact_obstacle: (nc,) row of the obstacle tables, -1 for a side of a pair.
        contact_pairs: (np, 2) rows of the contact tables for the two sides of each
            pair. A pair is two colliders on two bodies that may touch each other.
        obstacle_kind: (no,) see :class:`ObstacleKind`.
        obstacle_frame: (no, 7) pose in the world. The normal of a plane and the axis
            of a capsule are the local z axis.
        obstacle_size: (no, 3) size [m]. Capsule: radius, half length, 0. Box: half
            extents. Plane: zeros.
        scene_links: (ns,) names of the links that do not move: first the links of the
            robot that are fixed to the world, then the links of the scene.
        scene_frames: (ns, 7) frames of these links in the world.
        contact_stiffness: Stiffness of every contact [N/m].
        feet: (nf,) body index of each foot.
        feet_width: Width of the smooth contact step of a foot, as a share of the
            robot's weight [-].
        feet_tail: How the slope of this step decays for large loads:
            ``"exponential"`` or ``"algebraic"``.
        reports_bodies: Whether a step reports the kinematics of the bodies.
        torso: Body index of the torso.
        rest_q: (nq,) coordinates of the default pose. Its velocities are 0.

    Raises:
        ValueError: The length of a contact table is not that of ``contact_body``.
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
    feet_tail: str
    reports_bodies: bool

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
        for field in ("position", "segment", "radius", "obstacle"):
            # The kernels read these tables without checking their length.
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
    def substeps(self) -> int:
        """Physics steps in a control step."""
        chosen = self.robot.substeps
        assert chosen is not None  # the robot of a system has a number
        return chosen

    @property
    def h(self) -> float:
        """Duration of a substep [s]."""
        return self.robot.dt / self.substeps

    @property
    def torso_floats(self) -> bool:
        """Whether the torso has a free joint. Then its position is in ``q``."""
        return self.joint_kind[self.torso] == JointKind.FREE

    @property
    def roots(self) -> np.ndarray:
        """(nb,) first body of the tree of links of each body."""
        roots = np.arange(self.nb)
        for body, parent in enumerate(self.parent):
            if parent >= 0:
                roots[body] = roots[parent]
        return roots

    @property
    def free_root(self) -> int | None:
        """Body at the root of the torso's tree; ``None`` if it does not move freely."""
        root = int(self.roots[self.torso])
        return root if self.joint_kind[root] == JointKind.FREE else None

    @property
    def has_boxes(self) -> bool:
        """Whether an obstacle is a box. Boxes need another variant of the kernels."""
        return bool(np.any(self.obstacle_kind == ObstacleKind.BOX))

    @property
    def has_pairs(self) -> bool:
        """Whether bodies may touch each other. Pairs need another variant."""
        return bool(len(self.contact_pairs))

    @property
    def ground_contacts(self) -> np.ndarray:
        """Rows of the contact tables for the ground, which is obstacle 0."""
        return np.flatnonzero(self.contact_obstacle == 0)

    @property
    def total_mass(self) -> float:
        """Mass of the robot [kg]."""
        return float(self.mass.sum())


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Kinematics:
    """Poses and velocities of the bodies, in world axes.

    Attributes:
        position: (nb, 3) origin of the link frame [m].
        rotation: (nb, 4) quaternion xyzw of the link frame.
        com: (nb, 3) centre of mass [m].
        linear_velocity: (nb, 3) velocity of the centre of mass [m/s].
        angular_velocity: (nb, 3) angular velocity [rad/s].
    """

    position: jax.Array
    rotation: jax.Array
    com: jax.Array
    linear_velocity: jax.Array
    angular_velocity: jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PhysicsState:
    """State of a world, and values that the last step computed.

    A step reads only ``q`` and ``v`` and writes all fields. To create a state with
    other coordinates, call :func:`~newton_qd.physics.initial_state`.

    The coordinates of a free root are the position of the root origin and the
    quaternion xyzw. Its velocities are the linear velocity of the root origin and the
    angular velocity. All are in world axes.

    Attributes:
        q: (nq,) coordinates [m or rad].
        v: (nv,) velocities [m/s or rad/s].
        impulse: (nb, 6) contact impulse on each body over the control step, with
            friction, in world axes: linear [N s], then angular about the body's
            centre of mass [N m s].
        normal_impulse: (nb,) sum of the normal contact impulses on each body
            over the control step [N s]. Never negative.
        feet_contact: (nf,) 1 if a foot carried more than 1 % of the robot's weight
            over the control step, else 0. Its gradient is 0.
        smooth_feet_contact: (nf,) smooth version of ``feet_contact``: a smooth step
            with the system's ``feet_width`` and ``feet_tail``. It is 0.5 at the load
            where ``feet_contact`` switches.
        torso_xy: (2,) x and y of the torso's link frame [m].
        bodies: Kinematics of the bodies. ``None`` if the system does not report them.
    """

    q: jax.Array
    v: jax.Array
    impulse: jax.Array
    normal_impulse: jax.Array
    feet_contact: jax.Array
    smooth_feet_contact: jax.Array
    torso_xy: jax.Array
    bodies: Kinematics | None = None


def require_physics_state(state: object) -> None:
    """Checks that a value is the state of a world.

    Raises:
        TypeError: It is not.
    """
    allowed = "a PhysicsState, such as state.pipeline_state"
    checks.instance("state", state, PhysicsState, allowed)


Rest = ParamSpec("Rest")
Result = TypeVar("Result")


def takes_system(
    function: Callable[Concatenate[System, Rest], Result],
) -> Callable[Concatenate[System, Rest], Result]:
    """Decorates a function of a system: another first argument is a ``TypeError``."""

    @functools.wraps(function)
    def checked(system: System, *args: Rest.args, **options: Rest.kwargs) -> Result:
        allowed = "a System, such as env.unwrapped.system"
        checks.instance("system", system, System, allowed)
        return function(system, *args, **options)

    return checked
