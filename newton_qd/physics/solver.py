"""The physics as a Newton solver, for programs that use Newton's own loop."""

from __future__ import annotations

import dataclasses
import functools
import math
import warnings
from collections.abc import Sequence
from pathlib import Path

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverBase

from newton_qd import checks
from newton_qd.assets import find_urdf
from newton_qd.checks import Fact, message
from newton_qd.physics import layout
from newton_qd.physics.buffers import fill_row
from newton_qd.physics.kernels.conventions import read_rows, write_rows
from newton_qd.physics.kernels.rows import Inputs, Outputs
from newton_qd.physics.launch import Launcher
from newton_qd.physics.model import load_system, newton_builder
from newton_qd.physics.model.description import read_description
from newton_qd.physics.model.xml_reader import RobotDescriptionError
from newton_qd.physics.system import JointKind, System
from newton_qd.physics.warp_internals import tape_is_recording
from newton_qd.robots import RobotSpec

# Arrays of the model in which every world must equal the robot. They are grouped by
# what one row of the array belongs to.
_COMPARED = {
    "body": ("body_mass", "body_com", "body_inertia", "body_flags"),
    "joint": (
        "joint_type",
        "joint_parent",
        "joint_child",
        "joint_X_p",
        "joint_X_c",
        "joint_dof_dim",
        "joint_enabled",
        "joint_mimic_joint",
    ),
    "joint_dof": (
        "joint_axis",
        "joint_armature",
        "joint_damping",
        "joint_friction",
        "joint_stiffness",
        "joint_limit_lower",
        "joint_limit_upper",
        "joint_target_ke",
        "joint_target_kd",
    ),
    "joint_coord": ("joint_rest_q",),
}
# Arrays of indices that count over all worlds, and the count that each refers to.
_NUMBERED = {
    "joint_parent": "body_count",
    "joint_child": "body_count",
    "joint_mimic_joint": "joint_count",
}
_ABSENT = ("particle_count", "muscle_count", "tendon_count", "constraint_mimic_count")
# Maximum number of different step lengths whose models stay in memory.
_HELD_STEPS = 8


class NewtonQDSolver(SolverBase):
    """Steps a Newton model of identical worlds with the kernels of this package.

    Each world of the model contains one copy of the same robot::

        scene = newton.ModelBuilder()
        scene.replicate(newton_builder(path, floating=True, gravity=robot.gravity), 64)
        model = scene.finalize()
        solver = NewtonQDSolver(model, robot)
        solver.step(state_in, state_out, control, None, dt)

    The physics is the same as in :func:`newton_qd.physics.step`. The robot touches the
    ground z = 0 with the spheres and the material of its ``RobotSpec``. The solver
    therefore ignores: ``contacts``; the materials, limit gains and effort limits of the
    model; shapes without a body; ``State.body_f``; and every part of ``Control`` except
    ``joint_f``. ``joint_f`` is added to the passive joint forces.

    Joint velocities and forces follow Newton's convention: for a free joint they refer
    to the child's centre of mass. ``wp.Tape`` cannot differentiate the solver. For
    gradients use :func:`newton_qd.physics.step`. Before you capture a CUDA graph, step
    once with each ``dt`` that it uses, at most eight. Then every buffer exists and
    stays in memory.

    Attributes:
        fault: (worlds,) 1 if the last step met a non-finite value or a speed above
            1,000 [m/s or rad/s], else 0. A world with a fault keeps the coordinates and
            velocities of ``state_in``.
        impulse: (worlds, nb, 6) contact impulses of the last step, as in
            :class:`~newton_qd.physics.system.PhysicsState`.
        normal_impulse: (worlds, nb) normal contact impulses of the last step [N s].
    """

    def __init__(
        self,
        model: newton.Model,
        robot: RobotSpec,
        packages: Sequence[str | Path] = (),
    ) -> None:
        """Checks the model and allocates the buffers of a step.

        Args:
            model: Newton model. Each world is a copy of the robot.
            robot: The robot.
            packages: Folders of packages that ``newton_builder`` was given.

        Raises:
            ValueError: A world of ``model`` is not a copy of the robot. The message
                names the array that differs.
            TypeError: ``model`` is not a ``newton.Model``, or ``robot`` not a
                ``RobotSpec``.
            AssetNotFoundError: The robot's URDF file does not exist.
            RobotDescriptionError: The physics does not support the file or the robot.
        """
        checks.instance("model", model, newton.Model, "a newton.Model")
        checks.instance("robot", robot, RobotSpec, "a RobotSpec")
        super().__init__(model)
        self.robot = robot
        self._reference = _one_world(robot, model.device, packages)
        _check_model(model, self._reference, robot)
        self._system = load_system(robot, "float32")
        self._worlds = model.world_count
        nb, driven = self._system.nb, _driven_by_forces(self._system)
        self._read = fill_row(Inputs(), layout.inputs(driven))
        self._written = fill_row(Outputs(), layout.outputs(driven))
        with wp.ScopedDevice(model.device):
            self._inputs = self._zeros(self._read.size)
            self._outputs = self._zeros(self._written.size)
            self.impulse = self._zeros(nb, 6)
            self.normal_impulse = self._zeros(nb)
            self.fault = self._zeros()
        _check_roots(self._system)
        free = self._system.joint_kind[0] == JointKind.FREE
        self._root = (int(free), wp.vec3(*self._system.com[0]))
        self._launcher = functools.lru_cache(_HELD_STEPS)(
            functools.partial(_launcher, driven, model.device)
        )

    def step(
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control | None,
        contacts: newton.Contacts | None,
        dt: float,
        *,
        observables: SolverBase.Observables | None = None,
    ) -> None:
        """Advances every world by one substep of length ``dt``.

        Args:
            state_in: State to start from. Joint coordinates and velocities are read.
            state_out: State to write: joint coordinates and velocities, and poses and
                velocities of the bodies. It may be ``state_in``.
            control: ``joint_f`` is read: generalized forces [N or N m]. ``None``: the
                ``joint_f`` of the model.
            contacts: Ignored. ``None`` is allowed.
            dt: Duration of the substep [s]. The robot's ``RobotSpec`` was made for
                substeps of ``load_system(robot).h``.
            observables: Not supported. It must be ``None`` or empty.

        Raises:
            TypeError: A state is not a ``newton.State``.
            ValueError: ``dt`` is not positive, an array has the wrong size, or the
                value of an environment variable is not allowed.
            NotImplementedError: ``observables`` is not empty.
            RuntimeError: A ``wp.Tape`` is recording.
        """
        self.validate_observables(observables)
        for name, state in (("state_in", state_in), ("state_out", state_out)):
            checks.instance(name, state, newton.State, "a newton.State")
        checks.number("dt", dt, above=0)
        if tape_is_recording():
            raise RuntimeError(
                "NewtonQDSolver.step inside wp.Tape would record no gradient; "
                "differentiate newton_qd.physics.step with jax.grad instead"
            )
        joint_f = (self.model if control is None else control).joint_f
        q = self._rows("state_in.joint_q", state_in.joint_q, self._system.nq)
        qd = self._rows("state_in.joint_qd", state_in.joint_qd, self._system.nv)
        force = self._rows("control.joint_f", joint_f, self._system.nv)
        q_new = self._rows("state_out.joint_q", state_out.joint_q, self._system.nq)
        qd_new = self._rows("state_out.joint_qd", state_out.joint_qd, self._system.nv)
        worlds, x, y = self._worlds, self._inputs, self._outputs
        reports = (self.impulse.reshape((worlds, -1)), self.normal_impulse, self.fault)
        with wp.ScopedDevice(self.model.device):
            sources = [*self._root, q, qd, force, self._read]
            wp.launch(write_rows, dim=worlds, inputs=sources, outputs=[x])
            self._launcher(float(dt)).forward(worlds, x.flatten(), y.flatten())
            results = [q_new, qd_new, *reports]
            sources = [*self._root, self._written, y]
            wp.launch(read_rows, dim=worlds, inputs=sources, outputs=results)
        newton.eval_fk(self.model, q_new.flatten(), qd_new.flatten(), state_out)

    def notify_model_changed(self, flags: newton.ModelFlags | int) -> None:
        """Checks again that every world is a copy of the robot.

        Args:
            flags: Ignored. All arrays are checked.

        Raises:
            ValueError: A world is no longer a copy of the robot.
        """
        _check_model(self.model, self._reference, self.robot)

    def _rows(self, name: str, array: wp.array | None, columns: int) -> wp.array:
        """Returns the array as (worlds, columns), without a copy.

        Raises:
            ValueError: The array is missing, or has the wrong size.
        """
        size = self._worlds * columns
        if array is None or array.shape != (size,):
            given = None if array is None else Fact(f"shape {array.shape}")
            raise ValueError(message(name, given, f"shape ({size},)"))
        return array.reshape((self._worlds, columns))

    def _zeros(self, *shape: int) -> wp.array:
        return wp.zeros((self._worlds, *shape), dtype=wp.float32)


def _driven_by_forces(system: System) -> System:
    """Returns the system with one action for each degree of freedom: a force."""
    return dataclasses.replace(
        system,
        control_dof=np.arange(system.nv, dtype=np.int32),
        gear=np.ones(system.nv),
    )


def _launcher(system: System, device: wp.Device, dt: float) -> Launcher:
    """Returns the launcher of one substep with length ``dt`` [s]."""
    robot = dataclasses.replace(system.robot, dt=dt, substeps=1)
    return Launcher(dataclasses.replace(system, robot=robot), device)


def _one_world(
    robot: RobotSpec, device: wp.Device, packages: Sequence[str | Path]
) -> newton.Model:
    """Returns Newton's model of the robot alone, built as users build it."""
    path = find_urdf(robot.urdf)
    floating = read_description(path, robot.fixed_base).floating
    builder = newton_builder(str(path), floating, robot.gravity, packages=packages)
    with warnings.catch_warnings():
        # Newton has already warned about corrected inertias in the caller's model.
        warnings.simplefilter("ignore", newton.NewtonWarning)
        return builder.finalize(device=device)


def _check_model(model: newton.Model, one: newton.Model, robot: RobotSpec) -> None:
    """Checks that every world of ``model`` is equal to ``one``.

    Raises:
        ValueError: A world differs.
    """
    worlds = model.world_count
    for name in _ABSENT:
        if getattr(model, name):
            raise ValueError(message(f"model.{name}", getattr(model, name), "0"))
    for kind in _COMPARED:
        name = f"{kind}_count"
        found, expected = getattr(model, name), worlds * getattr(one, name)
        if worlds < 1 or found != expected:
            allowed = (
                f"{expected}: {worlds} worlds, each with one robot {robot.name!r} of "
                f"{getattr(one, name)}"
            )
            raise ValueError(message(f"model.{name}", found, allowed))
    for names in _COMPARED.values():
        for name in names:
            _compare(name, _per_world(model, name, worlds), _per_world(one, name, 1))
    gravity = model.gravity.numpy()[:worlds]
    _compare("gravity", gravity[:, None], one.gravity.numpy()[None, :1])
    for name in ("shape_type", "shape_transform", "shape_scale"):
        ours = _colliders(one, name, one.body_count)[0]
        for world, theirs in enumerate(_colliders(model, name, one.body_count)):
            if len(theirs) != len(ours):
                field = f"model.{name} of world {world}"
                given = Fact(f"{len(theirs)} colliders")
                allowed = f"{len(ours)}, as the robot has"
                raise ValueError(message(field, given, allowed))
            _compare(name, theirs[None], ours[None], world)


def _per_world(model: newton.Model, name: str, worlds: int) -> np.ndarray:
    """Returns an array of the model as (worlds, rows, entries)."""
    rows = getattr(model, name).numpy().reshape(worlds, -1)
    if name in _NUMBERED:
        per_world = getattr(model, _NUMBERED[name]) // worlds
        first = per_world * np.arange(worlds, dtype=rows.dtype)[:, None]
        rows = np.where(rows < 0, rows, rows - first)
    return rows


def _colliders(model: newton.Model, name: str, nb: int) -> list[np.ndarray]:
    """Returns the rows of a shape array for the colliders of each world.

    The rows are sorted by body.
    """
    body, flags = model.shape_body.numpy(), model.shape_flags.numpy()
    values = getattr(model, name).numpy()
    values = values.reshape(len(body), math.prod(values.shape[1:]))
    chosen = (body >= 0) & ((flags & int(newton.ShapeFlags.COLLIDE_SHAPES)) != 0)
    table = np.concatenate([body[:, None], values], axis=1)[chosen]
    table = table[np.argsort(table[:, 0], kind="stable")]
    worlds = table[:, 0] // nb
    table[:, 0] %= nb
    return [table[worlds == world] for world in range(model.body_count // nb)]


def _compare(
    name: str, worlds: np.ndarray, robot: np.ndarray, first_world: int = 0
) -> None:
    """Checks that the row of each world equals the row of the robot.

    Raises:
        ValueError: A row differs.
    """
    different = worlds != robot
    if different.any():
        place = tuple(np.argwhere(different)[0])
        field = f"model.{name} of world {first_world + place[0]}"
        allowed = (
            f"{robot[(0, *place[1:])]}, as the robot has; every world is an unchanged "
            "copy of newton_builder()'s"
        )
        raise ValueError(message(field, Fact(worlds[place]), allowed))


def _check_roots(system: System) -> None:
    """Checks that a free body whose centre of mass is off its origin is the first.

    Newton's velocities of a free joint are those of the centre of mass. They are
    converted for the first body only.

    Raises:
        RobotDescriptionError: Another body is free, and its centre of mass is off.
    """
    free = system.joint_kind == JointKind.FREE
    off = np.abs(system.com).max(axis=1) > 0
    for body in np.flatnonzero(free & off):
        if body > 0:
            given = Fact(f"{system.body_names[body]!r}, with its centre of mass off")
            allowed = "the first body, or one whose centre of mass is its origin"
            name = f"robot {system.robot.name!r}, free body"
            raise RobotDescriptionError(message(name, given, allowed))
