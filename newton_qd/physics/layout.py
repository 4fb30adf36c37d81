"""Layout of the rows of numbers that JAX, the launches and the kernels share.

Each world has one contiguous row of inputs and one row of outputs. A row is a list of
named fields. This module defines the fields, their order and their shapes. The bridge
uses it to join and split rows. The kernels get the offsets in their ``Model``. No other
module computes offsets.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

from newton_qd.physics.system import System


@dataclasses.dataclass(frozen=True)
class Field:
    """A part of a row.

    Attributes:
        name: Name of the field.
        shape: Shape of the field's array. The numbers are in row-major order.
        offset: Index of its first number in the row.
    """

    name: str
    shape: tuple[int, ...]
    offset: int

    @property
    def size(self) -> int:
        """Number of numbers in the field."""
        return math.prod(self.shape)


class Layout:
    """The fields of a row, in order and without gaps."""

    def __init__(self, shapes: dict[str, tuple[int, ...]]) -> None:
        """Computes the offsets of the fields.

        Args:
            shapes: Shape of each field, in the order of the row.
        """
        self.size = 0
        self._fields: dict[str, Field] = {}
        for name, shape in shapes.items():
            self._fields[name] = field = Field(name, shape, self.size)
            self.size += field.size

    def __iter__(self) -> Iterator[Field]:
        return iter(self._fields.values())

    def __getitem__(self, name: str) -> Field:
        return self._fields[name]

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each field, in the order of the row."""
        return {field.name: field.shape for field in self}

    @property
    def offsets(self) -> dict[str, int]:
        """Offset of each field."""
        return {field.name: field.offset for field in self}


def parameters(system: System) -> Layout:
    """Returns the row of a world's physical parameters: the ``PhysicsParams``."""
    nb, nv, nu = system.nb, system.nv, system.nu
    return Layout(
        {
            "gravity": (),
            "friction": (),
            "contact_stiffness_scale": (),
            "mass_scale": (nb,),
            "inertia_scale": (nb,),
            "damping_scale": (nv,),
            "gear_scale": (nu,),
        }
    )


def coordinates(system: System) -> Layout:
    """Returns the row that the inspection kernels read: ``q`` and ``v``."""
    return Layout({"q": (system.nq,), "v": (system.nv,)})


def inputs(system: System, parametric: bool = False) -> Layout:
    """Returns the row that a step reads.

    Args:
        system: The system.
        parametric: Whether each world has its own physical parameters.
    """
    own = parameters(system).shapes if parametric else {}
    return Layout({**coordinates(system).shapes, "control": (system.nu,), **own})


def bodies(system: System) -> Layout:
    """Returns the row of poses and velocities of the bodies: the ``Kinematics``."""
    nb = system.nb
    return Layout(
        {
            "position": (nb, 3),
            "rotation": (nb, 4),
            "com": (nb, 3),
            "linear_velocity": (nb, 3),
            "angular_velocity": (nb, 3),
        }
    )


def outputs(system: System) -> Layout:
    """Returns the row that a step writes: the ``PhysicsState`` fields and the fault."""
    nb, feet = system.nb, system.feet.shape
    seen = bodies(system).shapes if system.reports_bodies else {}
    return Layout(
        {
            **coordinates(system).shapes,
            "impulse": (nb, 6),
            "normal_impulse": (nb,),
            "fault": (),
            "feet_contact": feet,
            "smooth_feet_contact": feet,
            "torso_xy": (2,),
            **seen,
        }
    )


def dynamics(system: System) -> Layout:
    """Returns the row of the mass matrix and the bias forces."""
    return Layout({"mass_matrix": (system.nv, system.nv), "bias": (system.nv,)})


def gaps(system: System) -> Layout:
    """Returns the row of contact gaps."""
    return Layout({"gap": system.contact_body.shape})


def impulses(system: System) -> Layout:
    """Returns the row of contact impulses: linear, then its normal part."""
    shape = (system.substeps, len(system.contact_body), 4)
    return Layout({"impulse": shape})


def rows(
    system: System, kernel: str, parametric: bool = False
) -> tuple[Layout, Layout]:
    """Returns the rows that a kernel reads and writes.

    Args:
        system: The system.
        kernel: Name of the kernel. An adjoint has the rows of its kernel.
        parametric: Whether each world has its own physical parameters.
    """
    name = kernel.removesuffix("_forward").removesuffix("_backward")
    if name == "step":
        return inputs(system, parametric), outputs(system)
    if name == "contact_impulses":
        return inputs(system), impulses(system)
    written = {"bodies": bodies, "dynamics": dynamics, "contact_gaps": gaps}
    return coordinates(system), written[name](system)


def scratch_parameters(system: System) -> Layout:
    """Returns the row of values that a parametric kernel computes from its parameters.

    It computes them once at the start and keeps them in the scratch memory.
    """
    nb, nv = system.nb, system.nv
    return Layout(
        {
            "gravity": (),
            "friction": (),
            "contact_stiffness": (),
            "total_mass": (),
            "mass": (nb,),
            "inertia_scale": (nb,),
            "damping": (nv,),
        }
    )
