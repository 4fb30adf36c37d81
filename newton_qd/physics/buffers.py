"""Kernel structs in device memory: the model and the scratch memory."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from types import ModuleType
from typing import Any, Protocol, TypeVar

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from newton_qd.physics import layout, reference
from newton_qd.physics.kinds import Tail
from newton_qd.physics.layout import Layout
from newton_qd.physics.precision import Kernels, Variant, build_kernels, pack_width
from newton_qd.physics.stepping import substep_solves
from newton_qd.physics.system import CONTACT_FRACTION, STANDARD_GRAVITY, System
from newton_qd.physics.tree import Tree, build_tree
from newton_qd.physics.warp_internals import field_dtype, field_type

# Names of the scratch arrays, grouped by what one entry belongs to.
_PER_BODY = ("pose", "inertia", "moment")
_PER_MOTION = ("twist_w", "twist_v", "bias_w", "bias_v", "wrench_w", "wrench_v")
_PER_CONTACT = ("point", "arm", "normal", "velocity", "gap")
_PER_SOLVE_CONTACT = ("load", "push_n", "push", "weight_n")
_PER_SOLVE_CONTACT += ("weight_t", "slip")
_PER_SOLVE_DOF = ("dv", "joint_push", "joint_weight")
# Arrays of the linear solves. Their adjoint is written by hand and needs no memory.
_PER_SOLVE_BODY = ("change_w", "change_v", "lever_w", "lever_v", "share")
_ROOT_FACTORS = ("root_ww", "root_wv", "root_vv")
_ANSWERS = ("answer_w", "answer_v", "answer_dv")
_PAIRED = ("pair_weight", "pair_impulse", "pair_adjoint", "pair_w", "pair_v")
_PASSED = ("passed_ww", "passed_wv", "passed_vv", "passed_w", "passed_v", "effort")
_PASSED += ("multiplier_w", "multiplier_v")
_WITHOUT_ADJOINT = (*_PER_SOLVE_BODY, *_ROOT_FACTORS, *_ANSWERS, *_PAIRED)
_WITHOUT_ADJOINT += ("pair_coupling", "wrong", *_PASSED)
_PER_READING = ("body_impulse", "body_angular_impulse", "body_normal_impulse")
_PER_READING += ("position", "com", "com_velocity")
_REPORTED = ("impulse", "angular_impulse", "normal_impulse")


# The scratch begins at a multiple of this: a line is in as few cache lines as it can be
# [bytes].
_ALIGNMENT = 128

# Copies a table to the model's array of this name.
Put = Callable[[str, ArrayLike], None]


class _RowStruct(Protocol):
    size: int


Row = TypeVar("Row", bound=_RowStruct)


def _with_world(table: np.ndarray) -> np.ndarray:
    """Prepend a row for the world to a table of bodies. Kernels never read this row."""
    return np.concatenate([table[:1], table])


def kernels_of(system: System, device: wp.Device, parametric: bool = False) -> Kernels:
    """Returns the smallest variant of the kernels that fits a system and a device.

    Args:
        system: The system.
        device: Warp device.
        parametric: Whether each world has its own physical parameters.
    """
    width = pack_width(system.dtype, device)
    return build_kernels(
        Variant(system.dtype, width, parametric, system.has_boxes, system.has_pairs)
    )


def build_model(system: System, device: wp.Device, parametric: bool = False) -> Any:
    """Copy a system to a device as a ``Model`` struct.

    Args:
        system: The system. Its ``dtype`` selects the kernels.
        device: Warp device.
        parametric: Whether each world has its own physical parameters.

    Returns:
        The struct of :mod:`newton_qd.physics.kernels.structs`.
    """
    space = kernels_of(system, device, parametric)
    tree = build_tree(system)
    model = space.structs.Model()
    robot, material = system.robot, system.robot.material
    tables: dict[str, np.ndarray] = {}

    def put(name: str, values: ArrayLike) -> None:
        tables[name] = np.asarray(values)

    model.nb, model.nq, model.nv = system.nb, system.nq, system.nv
    model.nu, model.nc = system.nu, len(system.contact_body)
    model.substeps = system.substeps
    model.pairs = len(system.contact_pairs)
    solves = substep_solves(system)
    model.iterations, model.solves = solves.iterations, solves.solves
    model.given = solves.given
    model.friction_answers = solves.friction_answers
    model.follows = 1.0 if solves.given > 1 else 0.0
    model.h = system.h
    model.gravity = robot.gravity
    model.total_mass = system.total_mass
    put("rest_q", system.rest_q)
    put("origin_axis", reference.origin_axes(system))
    _put_bodies(put, system, tree)
    model.levels = len(tree.limb_level) - 1
    model.roots = int(tree.limb_level[1])
    _put_dofs(put, system)
    model.limit_smoothing = material.limit_smoothing
    model.limit_dissipation = material.limit_dissipation
    _put_contacts(put, system, tree)
    model.contact_stiffness = system.contact_stiffness
    model.contact_smoothing = material.smoothing
    model.friction = material.friction
    model.slip_velocity = material.slip_velocity
    model.dissipation = material.dissipation
    model.reports_bodies = int(system.reports_bodies)
    floats = system.torso_floats
    model.torso = system.torso + 1
    model.torso_q = int(system.q_start[system.torso]) if floats else -1
    model.nf = len(system.feet)
    put("foot", [int(body) + 1 for body in system.feet] or [0])
    gravity = robot.gravity or STANDARD_GRAVITY
    model.foot_weight = system.total_mass * gravity * robot.dt
    model.foot_fraction = CONTACT_FRACTION
    model.foot_width = system.feet_width
    model.foot_tail = Tail[system.feet_tail.upper()]
    _put_rows(model, space.structs, system, parametric)
    _copy_tables(model, space, tables, device)
    return model


def _copy_tables(
    model: Any, space: Kernels, tables: dict[str, np.ndarray], device: wp.Device
) -> None:
    """Copy the tables to a device: one array of the numbers, and one of the integers.

    The model keeps both arrays, and the address of each table.
    """
    kinds = {name: field_type(space.structs.Model, name) for name in tables}
    for memory, integer in (("numbers", False), ("integers", True)):
        parts = {
            name: values.ravel()
            for name, values in tables.items()
            if (kinds[name] is space.memory.IntTable) == integer
        }
        array = wp.array(
            np.concatenate(list(parts.values())),
            dtype=field_dtype(space.structs.Model, memory),
            device=device,
        )
        setattr(model, memory, array)
        address = array.ptr
        assert address is not None  # the array is not empty
        for name, part in parts.items():
            handle = kinds[name]()
            handle.data = address
            setattr(model, name, handle)
            address += part.size * wp.types.type_size_in_bytes(array.dtype)


def fill_row(struct: Row, fields: Layout, names: Iterable[str] | None = None) -> Row:
    """Write the offsets of a row's fields into a kernel struct.

    Args:
        struct: A struct of :mod:`newton_qd.physics.kernels.rows`. It is changed in
            place.
        fields: Layout of the row.
        names: Fields of the row that the struct has. ``None``: all.

    Returns:
        ``struct``.
    """
    struct.size = fields.size
    for name in fields.offsets if names is None else names:
        setattr(struct, name, fields[name].offset)
    return struct


def _put_rows(
    model: Any, structs: ModuleType, system: System, parametric: bool
) -> None:
    rows: dict[str, tuple[Any, Layout]] = {
        "inputs": (structs.Inputs(), layout.inputs(system, parametric)),
        "coordinates": (structs.Coordinates(), layout.coordinates(system)),
        "bodies": (structs.Bodies(), layout.bodies(system)),
        "dynamics": (structs.Dynamics(), layout.dynamics(system)),
        "parameters": (structs.Parameters(), layout.scratch_parameters(system)),
    }
    for name, (struct, fields) in rows.items():
        setattr(model, name, fill_row(struct, fields))
    written, seen = layout.outputs(system), layout.bodies(system).offsets
    names = [name for name in written.offsets if name not in seen]
    model.outputs = fill_row(structs.Outputs(), written, names)
    if system.reports_bodies:
        model.reported = fill_row(structs.Bodies(), written, seen)


def _put_bodies(put: Put, system: System, tree: Tree) -> None:
    put("body_parent", tree.body_parent)
    put("joint_kind", _with_world(system.joint_kind))
    put("q_start", _with_world(system.q_start))
    put("v_start", _with_world(system.v_start))
    put("joint_axis", _with_world(system.joint_axis))
    put("parent_frame", _with_world(system.parent_frame))
    inverse = np.asarray([reference.inverse(frame) for frame in system.child_frame])
    put("child_frame_inverse", _with_world(inverse))
    identity = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    moved = np.any(system.child_frame != identity, axis=1)
    put("child_moved", _with_world(moved.astype(np.int32)))
    put("mass", _with_world(system.mass))
    put("com", _with_world(system.com))
    put("inertia", _with_world(system.inertia))
    ball = system.inertia[:, :1, :1] * np.eye(3)
    isotropic = np.all(system.inertia == ball, axis=(1, 2))
    put("isotropic", _with_world(isotropic.astype(np.int32)))
    put("limb_level", tree.limb_level)
    put("limb_start", tree.limb[0])
    put("limb_body", tree.limb[1])
    put("child_start", tree.child[0])
    put("child", tree.child[1])


def _put_dofs(put: Put, system: System) -> None:
    control = np.full(system.nv, -1, np.int32)
    control[system.control_dof] = np.arange(system.nu)
    gear = np.zeros(system.nv)
    gear[system.control_dof] = system.gear
    # The smoothing zone of a limit is centred at the stored value. The value is moved
    # outwards by the width, so that the zone begins at the limit.
    width = system.robot.material.limit_smoothing
    put("dof_control", control)
    for name, values in {
        "gear": gear,
        "armature": system.armature,
        "damping": system.damping,
        "stiffness": system.stiffness,
        "spring_rest": system.spring_rest,
        # The bound is far beyond any angle. It is finite, because infinity times zero
        # stiffness is NaN.
        "limit_lower": np.clip(system.limit_lower - width, -1e9, 1e9),
        "limit_upper": np.clip(system.limit_upper + width, -1e9, 1e9),
        "limit_stiffness": system.limit_stiffness,
    }.items():
        put(name, values)


def _put_contacts(put: Put, system: System, tree: Tree) -> None:
    put("contact_start", tree.contact)
    paired = np.bincount(
        system.contact_body[system.contact_pairs.ravel()] + 1, minlength=system.nb + 1
    )
    put("contact_stop", tree.contact[1:] - paired)
    put("contact_body", system.contact_body + 1)
    put("contact_position", system.contact_position)
    put("contact_segment", system.contact_segment)
    put("contact_radius", system.contact_radius)
    put("contact_obstacle", system.contact_obstacle)
    partner, lead = np.full((2, len(system.contact_body)), -1, np.int32)
    first, second = system.contact_pairs.T
    partner[first], partner[second] = second, first
    lead[first] = lead[second] = first
    put("contact_partner", partner)
    put("contact_lead", lead)
    put("pair_lead", first if len(first) else [0])
    put("obstacle_kind", system.obstacle_kind)
    put("obstacle_frame", system.obstacle_frame)
    put("obstacle_size", system.obstacle_size)


def _entries(system: System, adjoint: bool) -> dict[str, int]:
    """Returns the length of each scratch array for one pack of worlds."""
    n, nc = system.substeps, max(len(system.contact_body), 1)
    nf = len(system.feet)
    chosen = substep_solves(system)
    turns = n * chosen.iterations
    # one more: the kinematics after the last substep
    steps = n + 1 if adjoint else 1
    motions = turns + 1 if adjoint else 1
    solves = turns * chosen.solves if adjoint else 1
    several = np.count_nonzero(system.parent < 0) > 1  # roots
    pairs = len(system.contact_pairs)
    coupled = solves * pairs
    return {
        "fault": 1,
        "lost": 1,
        "wrong": nc,
        "q": (n + 2) * system.nq,
        "v": (turns + 2) * system.nv,
        "ctrl": max(system.nu, 1),
        "parameter": layout.scratch_parameters(system).size,
        **dict.fromkeys(_PER_BODY, steps * (system.nb + 1)),
        **dict.fromkeys(_PER_MOTION, motions * (system.nb + 1)),
        **dict.fromkeys(("axis_w", "axis_v"), steps * system.nv),
        **dict.fromkeys(_PER_CONTACT, (n if adjoint else 1) * nc),
        **dict.fromkeys(_REPORTED, n * nc),
        **dict.fromkeys(_PER_SOLVE_CONTACT, solves * nc),
        **dict.fromkeys(_PER_SOLVE_BODY, solves * (system.nb + 1)),
        **dict.fromkeys(_PER_SOLVE_DOF, solves * system.nv),
        **dict.fromkeys(_ROOT_FACTORS, solves * (system.nb + 1 if several else 1)),
        **dict.fromkeys(_ANSWERS[:2], coupled * (system.nb + 1)),
        "answer_dv": coupled * system.nv,
        **dict.fromkeys(_PAIRED, coupled),
        "pair_coupling": coupled * pairs,
        **dict.fromkeys(_PASSED, system.nb + 1),
        **dict.fromkeys(_PER_READING, system.nb + 1),
        "torso_xy": 2,
        **dict.fromkeys(("foot_contact", "smooth_foot_contact"), max(nf, 1)),
    }


@dataclasses.dataclass(frozen=True)
class Memory:
    """Intermediate values of a step in device memory.

    Attributes:
        values: ``Scratch`` struct of the values.
        adjoints: ``Scratch`` struct of their adjoints. Without adjoints it is
            ``values`` itself. An array that needs no adjoint is in both.
        shapes: Shape of each array of a group of worlds: entries, numbers of an entry,
            worlds.
    """

    values: Any
    adjoints: Any
    shapes: dict[str, tuple[int, int, int]]

    def array(self, name: str, adjoint: bool = False) -> np.ndarray:
        """Returns a view of an array on a CPU, for the first group of worlds.

        Args:
            name: Field of ``Scratch``.
            adjoint: Whether to return the adjoints of the array.
        """
        struct = self.adjoints if adjoint else self.values
        entries, numbers, side = self.shapes[name]
        lines = struct.memory.numpy().reshape(-1, side)
        first = getattr(struct, name).first
        found = lines[first : first + entries * numbers]
        return found.reshape(self.shapes[name])


def build_scratch(
    system: System,
    slots: int,
    device: wp.Device,
    *,
    adjoint: bool,
    parametric: bool = False,
) -> Memory:
    """Allocate the intermediate values of ``slots`` packs of worlds.

    Args:
        system: The system.
        slots: Number of packs that the scratch memory holds at once.
        device: Warp device.
        adjoint: Whether to allocate adjoints, and memory for each substep. If false,
            the substeps share their memory.
        parametric: As in :func:`build_model`.

    Returns:
        The structs that the kernels take as arguments.
    """
    space = kernels_of(system, device, parametric)
    kind, memory = space.structs.Scratch, space.memory
    values, adjoints = kind(), kind()
    shapes, lines = {}, 0
    for name, count in _entries(system, adjoint).items():
        array = field_type(kind, name)
        shapes[name] = (count, memory.COUNTS[array], memory.SIDE)
        own = count * memory.COUNTS[array]
        both = adjoint and name not in _WITHOUT_ADJOINT
        first, second = lines, lines + own if both else lines
        lines = second + own
        for struct, line in ((values, first), (adjoints, second)):
            handle = array()
            handle.first, handle.adjoint = line, second
            setattr(struct, name, handle)
    width = pack_width(system.dtype, device)
    size = -(-slots * width // memory.SIDE) * memory.SIDE * lines
    whole = wp.zeros(
        size + _ALIGNMENT, dtype=field_dtype(kind, "memory"), device=device
    )
    assert whole.ptr is not None  # the array is not empty
    start = -whole.ptr % _ALIGNMENT // wp.types.type_size_in_bytes(whole.dtype)
    for struct in (values, adjoints):
        struct.memory, struct.lines = whole[start : start + size], lines
    return Memory(values, adjoints if adjoint else values, shapes)
