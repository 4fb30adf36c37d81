"""The settings of ``env.sys`` in the form of brax v1: joints and the default pose."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.envs.joints import joint_chains
from newton_qd.physics.system import JointKind, System

_DEGREES = 180.0 / math.pi
_FULL_TURN = 360.0  # a limit of an axis that turns freely [degree]


class Readings(tuple):
    """One array (nj,) per axis. As one array it is (nj axes,), joint by joint.

    The releases of brax v1 differ: older ones return one array per axis, newer ones a
    flat array. This value can be used in both ways.
    """

    __slots__ = ()

    def __jax_array__(self) -> jax.Array:
        """Returns all readings as one array (..., nj axes)."""
        rows = jnp.stack(tuple(self), axis=-1)
        return rows.reshape(*rows.shape[:-2], -1)

    def __array__(
        self, dtype: np.dtype | None = None, copy: bool | None = None
    ) -> np.ndarray:
        """Returns all readings as one array (..., nj axes) of NumPy."""
        return np.asarray(self.__jax_array__(), dtype)


jax.tree_util.register_pytree_node(
    Readings, lambda found: (tuple(found), None), lambda _, parts: Readings(parts)
)


@dataclasses.dataclass(frozen=True)
class Limit:
    """Limits of one axis: ``min`` and ``max`` [degree]."""

    min: float
    max: float


@dataclasses.dataclass(frozen=True)
class JointSettings:
    """A joint, as in brax v1's configuration.

    Attributes:
        name: Name of its last axis in the URDF file.
        parent: Name of the body that carries it; empty for the world.
        child: Name of the body that it moves.
        stiffness: Stiffness of the original's joint spring. Here 1: joints are exact.
        angle_limit: Limits of each axis.
    """

    name: str
    parent: str
    child: str
    stiffness: float
    angle_limit: tuple[Limit, ...]


@dataclasses.dataclass(frozen=True)
class Vector:
    """A vector; for a joint: one angle for each axis [degree]."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclasses.dataclass(frozen=True)
class DefaultAngle:
    """Angles of a joint in the default pose [degree]."""

    name: str
    angle: Vector


@dataclasses.dataclass(frozen=True)
class Defaults:
    """A default pose.

    Attributes:
        angles: Angles of every joint.
    """

    angles: tuple[DefaultAngle, ...]


def joint_settings(system: System) -> tuple[JointSettings, ...]:
    """Returns the joints of a robot, in the order of ``env.sys.joints``."""
    found = []
    for chain in _chains(system):
        limits = [
            Limit(_bound(system, axis, -1), _bound(system, axis, 1)) for axis in chain
        ]
        parent = int(system.parent[chain[0]])
        found.append(
            JointSettings(
                system.joint_names[chain[-1]],
                system.body_names[parent] if parent >= 0 else "",
                system.body_names[chain[-1]],
                1.0,
                tuple(limits),
            )
        )
    return tuple(found)


def default_pose(system: System) -> Defaults:
    """Returns the default pose of a robot."""
    return Defaults(
        tuple(
            DefaultAngle(
                system.joint_names[chain[-1]],
                Vector(*_angles(system, chain)),
            )
            for chain in _chains(system)
        )
    )


def _angles(system: System, chain: list[int]) -> list[float]:
    """Returns the angles of a joint [degree]; slides have none."""
    turning = [x for x in chain if system.joint_kind[x] == JointKind.REVOLUTE]
    return (system.rest_q[system.q_start[turning]] * _DEGREES).tolist()


def _chains(system: System) -> list[list[int]]:
    return sorted(joint_chains(system), key=len)


def _bound(system: System, axis: int, sign: int) -> float:
    limits = system.limit_upper if sign > 0 else system.limit_lower
    bound = float(limits[system.v_start[axis]])
    return bound * _DEGREES if math.isfinite(bound) else sign * _FULL_TURN
