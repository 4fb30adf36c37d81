"""The one table of what a row of numbers holds, for JAX, the launches and the kernels.

Every world has one contiguous row of inputs and one of outputs. A row is a list of
named fields; this module says which, in what order and of what shape. The bridge joins
and splits rows by it, and the kernels get its offsets in their ``Model``: nobody else
adds up sizes.
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
        name: What it is.
        shape: Shape of the array that its numbers are, row by row.
        offset: Where it begins.
    """

    name: str
    shape: tuple[int, ...]
    offset: int

    @property
    def size(self) -> int:
        """How many numbers it has."""
        return math.prod(self.shape)


class Layout:
    """The fields of a row, one after the other without gaps."""

    def __init__(self, shapes: dict[str, tuple[int, ...]]) -> None:
        """Places the fields.

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
        """Where each field begins."""
        return {field.name: field.offset for field in self}


def parameters(system: System) -> Layout:
    """Physical parameters of a world: the fields of ``PhysicsParams``."""
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
    """What the kernels read that show a state from inside."""
    return Layout({"q": (system.nq,), "v": (system.nv,)})


def inputs(system: System, parametric: bool = False) -> Layout:
    """What a step reads.

    Args:
        system: The system.
        parametric: Whether every world brings physical parameters of its own.
    """
    own = parameters(system).shapes if parametric else {}
    return Layout({**coordinates(system).shapes, "control": (system.nu,), **own})


def bodies(system: System) -> Layout:
    """Where the bodies are and how they move: the fields of ``Kinematics``."""
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
    """What a step writes: ``PhysicsState`` and the fault."""
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
    """The mass matrix and the bias forces."""
    return Layout({"mass_matrix": (system.nv, system.nv), "bias": (system.nv,)})


def gaps(system: System) -> Layout:
    """How far apart everything is that can touch."""
    return Layout({"gap": system.contact_body.shape})


def scratch_parameters(system: System) -> Layout:
    """What a kernel with parameters of each world makes of them, once for all."""
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
