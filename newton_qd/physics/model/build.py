"""Builds a System from a robot's URDF file and its ``RobotSpec``.

Newton imports the file and defines the order of bodies and coordinates. Newton stores
single precision. :mod:`newton_qd.physics.model.verify` checks that its numbers equal
those of the file. The System then takes the numbers from the file, in double precision.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from newton_qd import checks
from newton_qd.assets import find_urdf
from newton_qd.checks import Fact, listed, message
from newton_qd.errors import warn
from newton_qd.physics.model.arrays import body_arrays, dof_arrays
from newton_qd.physics.model.contacts import contact_tables
from newton_qd.physics.model.description import (
    Description,
    read_description,
    warn_about,
)
from newton_qd.physics.model.elements import UNLIMITED, Shape
from newton_qd.physics.model.inertia import check_inertia
from newton_qd.physics.model.kept_models import kept_or_built
from newton_qd.physics.model.limit_loads import SoftLimitWarning, soft_limits
from newton_qd.physics.model.named_links import feet_bodies, torso_body
from newton_qd.physics.model.newton_input import NewtonInput, merge_fixed_bodies
from newton_qd.physics.model.rest import rest_coordinates
from newton_qd.physics.model.robot_checks import check_robot, index_of, refusal
from newton_qd.physics.model.scene import check_scene, obstacle_tables, read_scene
from newton_qd.physics.model.substeps import (
    FewSubstepsWarning,
    few_substeps,
    recommended_substeps,
)
from newton_qd.physics.model.verify import BuiltModel, ModelMismatchError, verify
from newton_qd.physics.model.wall_speeds import SoftWallWarning, soft_walls
from newton_qd.physics.model.xml_reader import RobotDescriptionError
from newton_qd.physics.system import STANDARD_GRAVITY, TAILS, JointKind, System
from newton_qd.robots import RobotSpec
from newton_qd.scenes import Scene

if TYPE_CHECKING:
    import newton


def newton_builder(
    path: str,
    floating: bool,
    gravity: float,
    meshes: bool = True,
    packages: Sequence[str | Path] = (),
    drawn: bool = False,
) -> newton.ModelBuilder:
    """Imports a URDF file into a Newton builder, with the settings of this package.

    Nothing is downloaded. Meshes and textures are read only from the folder or the ROS
    package of the URDF file, from ``packages`` and from the folders below. What is only
    seen and cannot be read is left out, with a ``RobotDescriptionWarning``.

    Args:
        path: The file.
        floating: Whether the root link floats. If false, it is fixed to the world.
        gravity: Downward acceleration [m/s^2].
        meshes: Whether the files of meshes and textures are read.
        packages: Folders of packages: ``package://NAME/mesh.stl`` is found in a folder
            NAME, or in a folder that contains a folder NAME.
        drawn: Whether the robot is only drawn. The mesh of a collider may be left out,
            too, with a warning.

    Raises:
        RobotDescriptionError: The file is not XML, a colour is malformed, the mesh of a
            collider cannot be read, or a chain of joints is too long for Newton.
        OSError: The file cannot be read.
    """
    import newton

    given = NewtonInput(Path(path), meshes, packages, drawn)
    given.leave_out_unreadable(newton.ModelBuilder)
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -gravity))
    # Links without <inertial> have no mass. By default Newton computes a mass from the
    # colliders.
    builder.default_shape_cfg.density = 0.0
    try:
        builder.add_urdf(given.text(), floating=floating)
    except RecursionError as error:  # Newton calls a function inside itself
        name, given = f"{path}: longest chain of joints", Fact("about 1,000 or more")
        raise RobotDescriptionError(message(name, given, "hundreds")) from error
    fixed = [kind == newton.JointType.FIXED for kind in builder.joint_type]
    merge_fixed_bodies(builder, fixed)
    return builder


def _read_shapes(model: newton.Model) -> tuple[tuple[Shape, ...], ...]:
    """Returns the colliders of each body (nb,)."""
    from newton import GeoType, ShapeFlags

    kinds = {
        GeoType.SPHERE: "sphere",
        GeoType.CAPSULE: "capsule",
        GeoType.CYLINDER: "cylinder",
        GeoType.BOX: "box",
    }
    shapes: list[list[Shape]] = [[] for _ in range(model.body_count)]
    rows = zip(
        _numpy(model.shape_body),
        _numpy(model.shape_type),
        _numpy(model.shape_flags),
        _numpy(model.shape_transform).astype(np.float64),
        _numpy(model.shape_scale).astype(np.float64),
        strict=True,
    )
    for body, kind, flags, frame, size in rows:
        if body >= 0 and flags & ShapeFlags.COLLIDE_SHAPES:
            tag = kinds.get(GeoType(kind), GeoType(kind).name)
            shapes[body].append(Shape("", tag, frame, size))
    return tuple(tuple(found) for found in shapes)


def _numpy(array: object) -> np.ndarray:
    return array.numpy()  # type: ignore[attr-defined]


def _joint_kinds(model: newton.Model, description: Description) -> np.ndarray:
    """Returns the kinds (number of joints,) of Newton's joints.

    Raises:
        RobotDescriptionError: The kind of a joint is not supported.
    """
    from newton import JointType

    kinds = {
        JointType.FREE: JointKind.FREE,
        JointType.REVOLUTE: JointKind.REVOLUTE,
        JointType.PRISMATIC: JointKind.PRISMATIC,
    }
    found = []
    for label, number in zip(model.joint_label, _numpy(model.joint_type), strict=True):
        kind = JointType(number)
        if kind not in kinds:
            name = f"{description.path}: Newton's type of joint {label!r}"
            allowed = listed([known.name for known in kinds])
            raise RobotDescriptionError(message(name, Fact(kind.name), allowed))
        found.append(kinds[kind])
    return np.array(found, dtype=np.int32)


def _read_newton(model: newton.Model, description: Description) -> BuiltModel:
    """Copies the model into NumPy arrays ordered by body.

    Raises:
        ModelMismatchError: A body of Newton's model has no joint, or several.
    """
    prefix = f"{description.name}/" if description.name else ""
    kinds = _joint_kinds(model, description)
    child = _numpy(model.joint_child)
    order = np.argsort(child, kind="stable")
    if not np.array_equal(child[order], np.arange(model.body_count)):
        name = f"{description.path}: bodies that Newton's joints move"
        allowed = f"each of the {model.body_count} bodies once"
        raise ModelMismatchError(message(name, child.tolist(), allowed))
    v_start = _numpy(model.joint_qd_start)[:-1][order]
    single = kinds[order] != JointKind.FREE

    def per_joint(array: object, empty: float) -> np.ndarray:
        rows = _numpy(array).astype(np.float64)[v_start]
        rows[~single] = empty
        return rows

    def limits(array: object, empty: float) -> np.ndarray:
        rows = per_joint(array, empty)
        return np.where(np.abs(rows) >= UNLIMITED, np.copysign(np.inf, rows), rows)

    joint_names = [model.joint_label[joint].removeprefix(prefix) for joint in order]
    return BuiltModel(
        body_names=tuple(label.removeprefix(prefix) for label in model.body_label),
        joint_names=tuple(
            name if one else "" for name, one in zip(joint_names, single, strict=True)
        ),
        parent=_numpy(model.joint_parent)[order].astype(np.int32),
        joint_kind=kinds[order],
        q_start=_numpy(model.joint_q_start)[:-1][order].astype(np.int32),
        v_start=v_start.astype(np.int32),
        parent_frame=_numpy(model.joint_X_p)[order].astype(np.float64),
        child_frame=_numpy(model.joint_X_c)[order].astype(np.float64),
        axis=per_joint(model.joint_axis, 0.0),
        lower=limits(model.joint_limit_lower, -np.inf),
        upper=limits(model.joint_limit_upper, np.inf),
        damping=per_joint(model.joint_damping, 0.0),
        mass=_numpy(model.body_mass).astype(np.float64),
        com=_numpy(model.body_com).astype(np.float64),
        inertia=_numpy(model.body_inertia).astype(np.float64),
        shapes=_read_shapes(model),
    )


def _control(
    robot: RobotSpec, built: BuiltModel, fixed: tuple[str, ...]
) -> dict[str, np.ndarray]:
    for joint, _ in robot.actuators:
        if joint in fixed:
            allowed = listed([name for name in built.joint_names if name])
            raise refusal(robot, "actuators", joint, allowed, why="which is fixed")
    joints = [
        index_of(robot, "actuators", joint, built.joint_names)
        for joint, _ in robot.actuators
    ]
    return {
        "control_dof": built.v_start[np.array(joints, dtype=np.int32)],
        "gear": np.array([gear for _, gear in robot.actuators], dtype=np.float64),
    }


def _verified(robot: RobotSpec, description: Description) -> BuiltModel:
    """Builds Newton's model, and compares it with the file.

    Raises:
        RobotDescriptionError: The kind of a joint is not supported.
        ModelMismatchError: Newton's model differs from the file.
    """
    path, floating = str(description.path), description.floating
    builder = newton_builder(path, floating, robot.gravity, False)
    # The inertias of the file are already checked. Newton would change some silently.
    model = builder.finalize(skip_validation_inertia=True)
    built = _read_newton(model, description)
    verify(built, description)
    return built


def build_system(robot: RobotSpec, dtype: str, scene: Scene | None = None) -> System:
    """Builds the immutable description of a robot in a scene.

    Args:
        robot: The robot.
        dtype: Precision of the kernels: ``"float32"`` or ``"float64"``.
        scene: The obstacles on the flat ground. ``None``: no obstacles.

    Raises:
        TypeError: ``robot`` is not a ``RobotSpec``, or ``scene`` is not a ``Scene``.
        AssetNotFoundError: A URDF file does not exist.
        RobotDescriptionError: The physics does not support a file or the robot.
        ModelMismatchError: Newton's model differs from the file.
        ValueError: ``dtype`` is not allowed, or needs JAX's 64-bit mode.
    """
    return _system(robot, dtype, scene, _verified)


def _kept(robot: RobotSpec, description: Description) -> BuiltModel:
    """Returns the model that ``_verified`` builds, if possible from an earlier process.

    Raises:
        RobotDescriptionError: The kind of a joint is not supported.
        ModelMismatchError: Newton's model differs from the file.
    """
    build = functools.partial(_verified, robot, description)
    return kept_or_built(description, robot.gravity, build)


def _system(
    robot: RobotSpec,
    dtype: str,
    scene: Scene | None,
    newton_model: Callable[[RobotSpec, Description], BuiltModel],
) -> System:
    """Does what ``build_system`` says, with Newton's model of the robot."""
    dtype = checks.precision(dtype).name
    check_robot(robot)
    description = read_description(find_urdf(robot.urdf), robot.fixed_base)
    warn_about(description)
    built = newton_model(robot, description)
    bodies = [description.bodies[name] for name in built.body_names]
    links = () if scene is None else read_scene(scene)
    still = description.still | {link.name: link.frame for link in links}
    control, obstacles = (
        _control(robot, built, description.fixed),
        obstacle_tables(links),
    )
    total_mass = sum(body.link.mass for body in bodies)
    weight = total_mass * (robot.gravity or STANDARD_GRAVITY)
    material = robot.material
    system = System(
        robot=robot,
        scene=scene,
        dtype=dtype,
        body_names=built.body_names,
        joint_names=built.joint_names,
        parent=built.parent,
        joint_kind=built.joint_kind,
        q_start=built.q_start,
        v_start=built.v_start,
        contact_stiffness=weight / (material.support * material.static_penetration),
        **contact_tables(robot, scene, bodies, len(obstacles["obstacle_kind"])),
        feet=feet_bodies(robot, bodies),
        torso=torso_body(robot, bodies),
        rest_q=np.zeros(int(np.where(built.joint_kind == JointKind.FREE, 7, 1).sum())),
        feet_width=0.02,
        feet_tail="exponential",
        reports_bodies=False,
        **body_arrays(bodies),
        **dof_arrays(robot, built, bodies, control),
        **control,
        **obstacles,
        scene_links=tuple(still),
        scene_frames=np.array(list(still.values())).reshape(-1, 7),
    )
    system = dataclasses.replace(system, rest_q=rest_coordinates(system))
    check_inertia(system, description.path)
    if robot.substeps is None:
        chosen = dataclasses.replace(robot, substeps=recommended_substeps(system))
        system = dataclasses.replace(system, robot=chosen)
    return system


@functools.cache
def _cached_system(
    robot: RobotSpec, dtype: str, scene: Scene | None, files: tuple[bytes, ...]
) -> System:
    del files  # a file that somebody has edited is another robot
    return _system(robot, dtype, scene, _kept)


@functools.cache
def _cached_warnings(system: System) -> tuple[tuple[str, type[UserWarning]], ...]:
    found: list[tuple[str, type[UserWarning]]] = [
        (text, SoftWallWarning) for text in soft_walls(system)
    ]
    found += [(text, SoftLimitWarning) for text in soft_limits(system)]
    return *found, *((text, FewSubstepsWarning) for text in few_substeps(system))


@functools.cache
def _cached_variant(
    system: System, feet_width: float, feet_tail: str, reports_bodies: bool
) -> System:
    changes = {
        "feet_width": feet_width,
        "feet_tail": feet_tail,
        "reports_bodies": reports_bodies,
    }
    if all(getattr(system, name) == value for name, value in changes.items()):
        return system
    return dataclasses.replace(system, **changes)


def load_system(
    robot: RobotSpec,
    dtype: str = "float32",
    scene: Scene | None = None,
    *,
    feet_width: float | None = None,
    feet_tail: str = "exponential",
    reports_bodies: bool = False,
) -> System:
    """Returns the system of a robot. It is built once for the same arguments and files.

    A wall that does not hold the robot at 10 m/s gives a ``SoftWallWarning``:
    :func:`~newton_qd.physics.wall_speeds`. Too long substeps give a
    ``FewSubstepsWarning``: :func:`~newton_qd.physics.recommended_substeps`. A joint
    that carries much more than its limits hold gives a ``SoftLimitWarning``.

    Args:
        robot: The robot.
        dtype: Precision of the kernels: ``"float32"`` or ``"float64"``. ``"float64"``
            needs JAX's 64-bit mode.
        scene: The obstacles on the flat ground. ``None``: no obstacles.
        feet_width: Width of the smooth contact step of a foot, as a share of the
            robot's weight [-], above 0. ``None``: 0.02.
        feet_tail: How the slope of this step decays for large loads:
            ``"exponential"``, or ``"algebraic"`` with the inverse square of the load.
        reports_bodies: Whether a step reports the kinematics of the bodies.

    Raises:
        TypeError: ``robot`` is not a ``RobotSpec``, or ``scene`` is not a ``Scene``.
        AssetNotFoundError: A URDF file does not exist.
        RobotDescriptionError: The physics does not support a file or the robot.
        ModelMismatchError: Newton's model differs from the file.
        ValueError: ``dtype`` is not allowed, or needs JAX's 64-bit mode. Or
            ``feet_width`` is not above 0, or ``feet_tail`` is not allowed.
    """
    dtype = checks.precision(dtype).name
    checks.number(
        "feet_width", feet_width, above=0, endless=True, optional=True, error=ValueError
    )
    checks.choice("feet_tail", feet_tail, TAILS)
    check_robot(robot)  # before the cache computes its hash
    check_scene(scene)
    files = [find_urdf(one.urdf) for one in (robot, scene) if one is not None]
    contents = tuple(file.read_bytes() for file in files)
    system = _cached_system(robot, dtype, scene, contents)
    for text, category in _cached_warnings(system):
        warn(text, category)
    width = system.feet_width if feet_width is None else feet_width
    return _cached_variant(system, width, feet_tail, reports_bodies)
