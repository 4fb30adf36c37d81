"""Views for code that was written for brax v1: the bodies of a state, and the robot.

Both are computed from the physics state when they are read. One row is one body: first
the links of the robot in the order of its URDF file, then the ground. Links below
1e-5 kg have no row. They connect the axes of one joint of the original.
"""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import physics
from newton_qd.brax_views.configuration import (
    Defaults,
    JointSettings,
    Readings,
    default_pose,
    joint_settings,
)
from newton_qd.checks import Fact, message
from newton_qd.envs.joints import joint_chains, joint_indices, solid_bodies
from newton_qd.physics.system import PhysicsState, System

_GROUND = ("Ground", "floor")  # names of the last row in the original


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class QP:
    """Poses and velocities of the bodies, in world axes; read-only.

    Attributes:
        pos: (nr, 3) centre of mass of each body [m].
        rot: (nr, 4) quaternion wxyz.
        vel: (nr, 3) velocity of the centre of mass [m/s].
        ang: (nr, 3) angular velocity [rad/s].
        physics: The simulation state of these bodies.
    """

    pos: jax.Array
    rot: jax.Array
    vel: jax.Array
    ang: jax.Array
    physics: PhysicsState


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Changes:
    """Velocity changes of the bodies over a control step, world axes.

    Attributes:
        vel: (nr, 3) of the centre of mass [m/s].
        ang: (nr, 3) of the angular velocity [rad/s].
    """

    vel: jax.Array
    ang: jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Info:
    """Readings of the last control step.

    Attributes:
        contact: Velocity changes by contact, zero after a reset.
    """

    contact: Changes


@dataclasses.dataclass(frozen=True, eq=False)
class Bodies:
    """The rows of a view.

    Attributes:
        index: Row of each body, by link and by its name in the original.
    """

    index: Mapping[str, int]


@dataclasses.dataclass(frozen=True, eq=False)
class Joints:
    """All joints with the same number of axes.

    Attributes:
        q: (nj, axes) coordinate of each axis.
        v: (nj, axes) degree of freedom of each axis.
    """

    q: np.ndarray
    v: np.ndarray

    def angle_vel(self, qp: QP) -> tuple[Readings, Readings]:
        """Returns angles and rates, each as one array (nj,) per axis [rad, rad/s].

        Both are also one flat array for functions of JAX and NumPy. A rate is the time
        derivative of its angle. The original has the opposite sign.
        """
        axes = range(self.q.shape[1])
        return (
            Readings(qp.physics.q[..., self.q[:, axis]] for axis in axes),
            Readings(qp.physics.v[..., self.v[:, axis]] for axis in axes),
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Config:
    """Settings of the simulation.

    Attributes:
        dt: Duration of a step, with repeated actions [s].
        substeps: Physics steps in a step [-].
        joints: The joints, in the order of ``env.sys.joints``.
        defaults: The default pose, as the only entry.
        dynamics_mode: Name of the original's simulation; QDax uses this one.
    """

    dt: float
    substeps: int
    joints: tuple[JointSettings, ...] = ()
    defaults: tuple[Defaults, ...] = ()
    dynamics_mode: str = "legacy_spring"


class SystemView:
    """The robot as ``env.sys`` of brax v1; read-only."""

    def __init__(
        self,
        system: System,
        action_repeat: int = 1,
        body_names: Mapping[str, str] = types.MappingProxyType({}),
    ) -> None:
        """Creates the view.

        Args:
            system: The robot.
            action_repeat: Control steps for each action.
            body_names: Name of a link's body in the original, if it differs from the
                name of the link.
        """
        self._system = system
        self._repeat = action_repeat
        self._names = body_names

    @property
    def body(self) -> Bodies:
        """The rows of a view."""
        system, names = self._system, self._names
        rows: dict[str, int] = {}
        for row, body in enumerate(solid_bodies(system)):
            link = system.body_names[body]
            rows[link] = row
            if link in names:
                rows[names[link]] = row
        first = len(solid_bodies(system))
        for row, (aliases, _) in enumerate(_still_bodies(system), first):
            rows.update(dict.fromkeys(aliases, row))
        return Bodies(types.MappingProxyType(rows))

    @property
    def joints(self) -> tuple[Joints, ...]:
        """The joints of the robot, grouped by their number of axes."""
        groups: dict[int, list[list[int]]] = {}
        for chain in joint_chains(self._system):
            groups.setdefault(len(chain), []).append(chain)
        system = self._system
        return tuple(
            Joints(
                system.q_start[np.array(groups[axes])].astype(np.int32),
                system.v_start[np.array(groups[axes])].astype(np.int32),
            )
            for axes in sorted(groups)
        )

    @property
    def num_joint_dof(self) -> int:
        """Number of axes of all joints."""
        return sum(len(chain) for chain in joint_chains(self._system))

    @property
    def config(self) -> Config:
        """Settings of the simulation."""
        system = self._system
        return Config(
            system.robot.dt * self._repeat,
            system.substeps * self._repeat,
            joint_settings(system),
            (default_pose(system),),
        )

    @property
    def system(self) -> System:
        """The robot."""
        return self._system

    def default_angle(self) -> jax.Array:
        """Returns the joint angles (num_joint_dof,) of the default pose [rad].

        They are in depth-first order along the tree of links, joint by joint.
        """
        system = self._system
        q, _ = joint_indices(system)
        return jnp.asarray(system.rest_q[q], jnp.dtype(system.dtype))

    def default_qp(
        self,
        joint_angle: jax.Array | None = None,
        joint_velocity: jax.Array | None = None,
    ) -> QP:
        """Returns the default pose, standing on the ground.

        Args:
            joint_angle: (num_joint_dof,) angles in the order of ``default_angle``
                [rad]; ``None``: ``default_angle``.
            joint_velocity: (num_joint_dof,) velocities [rad/s]; ``None``: 0.

        Raises:
            ValueError: An array has the wrong shape.
        """
        system = self._system
        dtype = jnp.dtype(system.dtype)
        q, v = jnp.asarray(system.rest_q, dtype), jnp.zeros((system.nv,), dtype)
        joint_q, joint_v = joint_indices(system)
        if joint_angle is not None:
            q = q.at[joint_q].set(_checked("joint_angle", joint_angle, joint_q, dtype))
            q = physics.on_ground(system, q)
        if joint_velocity is not None:
            v = v.at[joint_v].set(
                _checked("joint_velocity", joint_velocity, joint_v, dtype)
            )
        return qp_view(system, physics.initial_state(system, q, v))

    def info(self, qp: QP) -> Info:
        """Returns the readings of the step that led to a view."""
        system = self._system
        bodies = solid_bodies(system)
        impulse = qp.physics.impulse[..., bodies, :]
        dtype = impulse.dtype
        mass = np.asarray(system.mass[bodies], dtype)[:, None]
        inverse = np.asarray(np.linalg.inv(system.inertia[bodies]), dtype)
        rot = qp.rot[..., : len(bodies), :]
        local = _rotate(rot * np.array([1, -1, -1, -1], dtype), impulse[..., 3:])
        turned = jnp.sum(inverse * local[..., None, :], axis=-1)
        changes = impulse[..., :3] / mass, _rotate(rot, turned)
        return Info(Changes(*(_with_still(system, change) for change in changes)))


def qp_view(system: System, state: PhysicsState) -> QP:
    """Returns the bodies of a state, with all batch axes in front."""

    def read(state: PhysicsState) -> tuple[jax.Array, ...]:
        found = physics.seen_bodies(system, state)
        bodies = solid_bodies(system)
        rotation = found.rotation[bodies]
        frames = np.array([frame for _, frame in _still_bodies(system)], state.q.dtype)
        rot = jnp.concatenate([rotation[:, 3:], rotation[:, :3]], axis=1)
        return (
            jnp.concatenate([found.com[bodies], frames[:, :3]]),
            jnp.concatenate([rot, frames[:, [6, 3, 4, 5]]]),
            _with_still(system, found.linear_velocity[bodies]),
            _with_still(system, found.angular_velocity[bodies]),
        )

    for _ in range(state.q.ndim - 1):
        read = jax.vmap(read)
    return QP(*read(state), physics=state)


def _checked(
    name: str, values: jax.Array, indices: np.ndarray, dtype: jnp.dtype
) -> jax.Array:
    if jnp.shape(values) != indices.shape:
        given = Fact(f"shape {jnp.shape(values)}")
        raise ValueError(message(name, given, f"shape {indices.shape}"))
    return jnp.asarray(values, dtype)


def _rotate(rot: jax.Array, vector: jax.Array) -> jax.Array:
    """Rotates (..., 3) by quaternions wxyz (..., 4)."""
    turned = 2.0 * jnp.cross(rot[..., 1:], vector)
    return vector + rot[..., :1] * turned + jnp.cross(rot[..., 1:], turned)


def _still_bodies(system: System) -> list[tuple[tuple[str, ...], np.ndarray]]:
    """Returns the names and the world frame (7,) of each body that never moves."""
    ground = (_GROUND, np.array([0, 0, 0, 0, 0, 0, 1.0]))
    scene = zip(system.scene_links, system.scene_frames, strict=True)
    # the original's names begin with a capital letter: Trap, Maze, Target
    return [ground, *(((name, name.capitalize()), frame) for name, frame in scene)]


def _with_still(system: System, rows: jax.Array) -> jax.Array:
    """Returns rows (..., nb, 3) with zeros appended for bodies that never move."""
    shape = (*rows.shape[:-2], len(_still_bodies(system)), 3)
    return jnp.concatenate([rows, jnp.zeros(shape, rows.dtype)], axis=-2)
