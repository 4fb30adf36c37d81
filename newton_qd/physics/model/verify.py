"""Checks that Newton's model equals the robot in the URDF file.

Newton replaces missing values silently: a missing size becomes 1, and a link without
inertia gets the mass of its colliders. This package therefore uses the model only after
the check. Newton stores single precision. The model and the file must be equal up to
its rounding.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike

from newton_qd.physics.model.description import Body, Description
from newton_qd.physics.model.elements import Shape
from newton_qd.physics.model.xml_reader import IDENTITY, RobotDescriptionError
from newton_qd.physics.system import JointKind

# A few rounding errors of single precision, relative to the largest compared number.
_TOLERANCE = 2e-6
_KINDS = {
    "revolute": JointKind.REVOLUTE,
    "continuous": JointKind.REVOLUTE,
    "prismatic": JointKind.PRISMATIC,
}


class ModelMismatchError(RobotDescriptionError):
    """Newton's model differs from the URDF file."""


@dataclasses.dataclass(frozen=True, eq=False)
class BuiltModel:
    """Newton's model in NumPy arrays. Joint ``i`` moves body ``i``.

    Attributes:
        body_names: (nb,) link names, parents first.
        joint_names: (nb,) joint names; empty for a floating root.
        parent: (nb,) parent body, -1 for the world.
        joint_kind: (nb,) see :class:`JointKind`.
        q_start: (nb,) first coordinate of each joint.
        v_start: (nb,) first degree of freedom of each joint.
        parent_frame: (nb, 7) joint frame in the parent body [m], xyzw.
        child_frame: (nb, 7) joint frame in the child body [m], xyzw.
        axis: (nb, 3) axis in the joint frame, zeros for a free joint.
        lower: (nb,) lower limit [rad or m], -inf without a limit.
        upper: (nb,) upper limit [rad or m], +inf without a limit.
        damping: (nb,) damping [N m s/rad or N s/m].
        mass: (nb,) mass [kg].
        com: (nb, 3) centre of mass in the body frame [m].
        inertia: (nb, 3, 3) inertia about the centre of mass, body axes [kg m^2].
        shapes: (nb,) colliders of each body.
    """

    body_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    parent: np.ndarray
    joint_kind: np.ndarray
    q_start: np.ndarray
    v_start: np.ndarray
    parent_frame: np.ndarray
    child_frame: np.ndarray
    axis: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    damping: np.ndarray
    mass: np.ndarray
    com: np.ndarray
    inertia: np.ndarray
    shapes: tuple[tuple[Shape, ...], ...]


def _near(expected: ArrayLike, built: ArrayLike, scale: float = 0.0) -> bool:
    """Returns whether two arrays agree, up to a tolerance.

    The tolerance is relative to the largest expected entry or ``scale``, whichever is
    larger.
    """
    expected, built = np.atleast_1d(expected), np.atleast_1d(built)
    if expected.shape != built.shape:
        return False
    finite = np.isfinite(expected)
    if not np.array_equal(expected[~finite], built[~finite]):
        return False
    expected, built = expected[finite], built[finite]
    largest = max(scale, float(np.abs(expected).max(initial=0.0)))
    return bool(np.all(np.abs(expected - built) <= _TOLERANCE * largest))


def _same_frame(expected: np.ndarray, built: np.ndarray) -> bool:
    # A quaternion and its negative are the same rotation. Lengths below 1 m have an
    # absolute tolerance, because they may be differences of longer lengths.
    rotation = built[3:] * (1.0 if expected[3:] @ built[3:] >= 0 else -1.0)
    return _near(expected[:3], built[:3], 1.0) and _near(expected[3:], rotation, 1.0)


def _same_shape(expected: Shape, built: Shape) -> bool:
    return (
        expected.kind == built.kind
        and _same_frame(expected.frame, built.frame)
        and _near(expected.size, built.size)
    )


def _describe(shape: Shape) -> str:
    return f"{shape.kind} at {shape.frame.tolist()} of size {shape.size.tolist()}"


class _Checker:
    def __init__(self, built: BuiltModel, description: Description):
        self.built = built
        self.description = description

    def fail(self, what: str, name: str, expected: object, built: object) -> None:
        if isinstance(expected, np.ndarray):
            expected = expected.tolist()
        if isinstance(built, np.ndarray):
            built = built.tolist()
        raise ModelMismatchError(
            f"{self.description.path}: {what} of {name} is {expected} in the file but "
            f"{built} in Newton's model"
        )

    def names(self) -> None:
        expected, built = set(self.description.bodies), set(self.built.body_names)
        if expected != built or len(built) != len(self.built.body_names):
            self.fail("the bodies", "the robot", sorted(expected), sorted(built))

    def link(self, index: int, body: Body) -> None:
        name, link, built = f"link {body.link.name!r}", body.link, self.built
        if not _near(link.mass, built.mass[index]):
            self.fail("mass", name, link.mass, float(built.mass[index]))
        if not _near(link.com, built.com[index], 1.0):
            self.fail("centre of mass", name, link.com, built.com[index])
        if not _near(link.inertia, built.inertia[index]):
            self.fail("inertia", name, link.inertia, built.inertia[index])

    def shapes(self, index: int, body: Body) -> None:
        left = list(self.built.shapes[index])
        for shape in body.shapes:
            if shape.kind == "mesh":
                continue  # nothing touches a mesh, so Newton does not read its file
            match = next((other for other in left if _same_shape(shape, other)), None)
            if match is None:
                found = [_describe(other) for other in left]
                self.fail("collider", f"link {shape.link!r}", _describe(shape), found)
            left = [other for other in left if other is not match]
        if left:
            names = f"link {body.link.name!r}"
            self.fail("a collider", names, "absent", _describe(left[0]))

    def joint(self, index: int, body: Body) -> None:
        built = self.built
        names = built.body_names
        parent = None if built.parent[index] < 0 else names[built.parent[index]]
        name = f"link {body.link.name!r}"
        if parent != body.parent:
            self.fail("parent", name, body.parent or "world", parent or "world")
        joint = body.joint
        kind = JointKind.FREE if joint is None else _KINDS[joint.kind]
        if kind != built.joint_kind[index]:
            found = JointKind(built.joint_kind[index]).name
            self.fail("joint type", name, kind.name, found)
        frame = IDENTITY if joint is None else joint.frame
        if not _same_frame(frame, built.parent_frame[index]):
            self.fail("joint frame", name, frame, built.parent_frame[index])
        if not _same_frame(IDENTITY, built.child_frame[index]):
            self.fail(
                "joint frame in the link", name, IDENTITY, built.child_frame[index]
            )
        if joint is None:
            return
        name = f"joint {joint.name!r}"
        if built.joint_names[index] != joint.name:
            self.fail("name", name, joint.name, built.joint_names[index])
        if not _near(joint.axis, built.axis[index]):
            self.fail("axis", name, joint.axis, built.axis[index])
        for what in ("lower", "upper", "damping"):
            expected, found = getattr(joint, what), float(getattr(built, what)[index])
            if not _near(expected, found):
                label = what if what == "damping" else f"{what} limit"
                self.fail(label, name, expected, found)


def verify(built: BuiltModel, description: Description) -> None:
    """Compares every number of the model with the file.

    Args:
        built: Newton's model.
        description: The content of the file, read without Newton.

    Raises:
        ModelMismatchError: They differ. The message names the link or joint and both
            values.
    """
    checker = _Checker(built, description)
    checker.names()
    for index, name in enumerate(built.body_names):
        body = description.bodies[name]
        checker.link(index, body)
        checker.joint(index, body)
        checker.shapes(index, body)
