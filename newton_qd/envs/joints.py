"""The joints of a robot, and the coordinates of their axes."""

from __future__ import annotations

import numpy as np

from newton_qd.checks import listed, message
from newton_qd.physics.system import JointKind, System

_LIGHTEST = 1e-5  # [kg]


def solid_bodies(system: System) -> np.ndarray:
    """Returns the bodies (n,) of 1e-5 kg or more.

    Lighter bodies are links between the axes of one joint.
    """
    return np.flatnonzero(system.mass >= _LIGHTEST).astype(np.int32)


def joint_chains(system: System) -> list[list[int]]:
    """Returns, for each joint of a robot, its axes in order from the parent.

    A joint connects two solid bodies, or is a hinge between a body and the world. A
    body that slides or floats in the world is a root.
    """
    solid = set(solid_bodies(system).tolist())
    chains = []
    for body in sorted(solid):
        chain, parent = [body], int(system.parent[body])
        while parent >= 0 and parent not in solid:
            chain.insert(0, parent)
            parent = int(system.parent[parent])
        hinges = np.all(system.joint_kind[chain] == JointKind.REVOLUTE)
        if parent >= 0 or hinges:
            chains.append(chain)
    return chains


def joint_indices(system: System) -> tuple[np.ndarray, np.ndarray]:
    """Returns coordinates (n,) and degrees of freedom (n,) of the axes of all joints.

    They are in depth-first order along the tree of links, joint by joint.
    """
    axes = [axis for chain in joint_chains(system) for axis in chain]
    q, v = system.q_start[axes], system.v_start[axes]
    return q.astype(np.int32), v.astype(np.int32)


def joint_slices(system: System, name: str) -> tuple[slice, slice]:
    """Returns the slices of a joint in the coordinates and in the velocities.

    Args:
        system: The robot.
        name: Name of the joint in the URDF file.

    Raises:
        ValueError: The robot has no such joint.
    """
    if not name or name not in system.joint_names:
        known = listed([known for known in system.joint_names if known])
        why = f"which is no joint of {system.robot.name}"
        raise ValueError(message("name", name, known, why=why))
    body = system.joint_names.index(name)
    parts = []
    for starts, size in ((system.q_start, system.nq), (system.v_start, system.nv)):
        later = [int(start) for start in starts if start > starts[body]]
        parts.append(slice(int(starts[body]), min([*later, size])))
    return parts[0], parts[1]
