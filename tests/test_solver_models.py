"""Which models and arguments the solver takes, and what it says of others."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import newton
import pytest
import warp as wp
from newton_loops import ARM, Loop, finalized, off_centre, one_world, replicated
from urdf_text import joint, link, robot_text, row, sphere, write

from newton_qd.physics.model import RobotDescriptionError, newton_builder
from newton_qd.physics.solver import NewtonQDSolver
from newton_qd.robots import ANT, RobotSpec

pytestmark = pytest.mark.usefixtures("newton_without_adjoints")


def test_models_that_are_accepted(tmp_path: Path, device: jax.Device) -> None:
    robot = off_centre(tmp_path, ARM, sphere(0.1))
    one = NewtonQDSolver(finalized(one_world(robot), device), robot)
    assert one.fault.shape == (1,)
    scene = newton.ModelBuilder()
    scene.add_ground_plane()
    scene.add_world(one_world(robot))
    scene.add_world(one_world(robot))
    two = NewtonQDSolver(finalized(scene, device), robot)
    assert two.fault.shape == (2,)


def _edited(name: str, index: Any, value: float) -> Callable[[newton.Model], None]:
    def edit(model: newton.Model) -> None:
        array = getattr(model, name)
        values = array.numpy()
        values[index] = value
        array.assign(values)

    return edit


@pytest.mark.parametrize(
    ("name", "world", "edit"),
    [
        ("body_mass", 1, _edited("body_mass", 2, 2.5)),
        ("body_com", 2, _edited("body_com", (5, 0), 0.5)),
        ("body_inertia", 0, _edited("body_inertia", (0, 1, 1), 9.0)),
        ("joint_X_p", 1, _edited("joint_X_p", (3, 2), 0.5)),
        ("joint_parent", 2, _edited("joint_parent", 5, 0)),
        ("joint_axis", 1, _edited("joint_axis", (13, 0), -0.5)),
        ("joint_armature", 0, _edited("joint_armature", slice(None), 0.01)),
        ("joint_target_ke", 2, _edited("joint_target_ke", 20, 10.0)),
        ("gravity", 1, _edited("gravity", (1, 2), -1.6)),
        ("shape_scale", 1, _edited("shape_scale", (1, 0), 0.3)),
    ],
)
def test_worlds_must_be_identical(
    tmp_path: Path,
    device: jax.Device,
    name: str,
    world: int,
    edit: Callable[[newton.Model], None],
) -> None:
    robot = off_centre(tmp_path, ARM, sphere(0.1))
    model = finalized(replicated(robot, 3), device)
    solver = NewtonQDSolver(model, robot)
    edit(model)
    with pytest.raises(ValueError, match=rf"model\.{name} of world {world}: got"):
        NewtonQDSolver(model, robot)
    with pytest.raises(ValueError, match=rf"model\.{name}"):
        solver.notify_model_changed(0)


def _particle(scene: newton.ModelBuilder, robot: RobotSpec) -> None:
    scene.add_particle((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), mass=1.0)


def _other_robot(scene: newton.ModelBuilder, robot: RobotSpec) -> None:
    scene.add_world(one_world(ANT))


def _two_in_a_world(scene: newton.ModelBuilder, robot: RobotSpec) -> None:
    scene.begin_world()
    for _ in range(2):
        scene.add_builder(one_world(robot))
    scene.end_world()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_particle, "model.particle_count: got 1; allowed: 0"),
        (_other_robot, "model.body_count: got 13; allowed: 6: 3 worlds, each with one"),
        (_two_in_a_world, "model.body_count: got 8; allowed: 6"),
    ],
)
def test_other_things_in_the_model(
    tmp_path: Path, device: jax.Device, change: Callable, message: str
) -> None:
    robot = off_centre(tmp_path, ARM)
    scene = replicated(robot, 2)
    change(scene, robot)
    with pytest.raises(ValueError, match=message):
        NewtonQDSolver(finalized(scene, device), robot)


def test_another_joint_and_nothing(tmp_path: Path, device: jax.Device) -> None:
    robot = off_centre(tmp_path, ARM)
    builder = one_world(robot)
    builder.joint_type[1] = newton.JointType.PRISMATIC
    with pytest.raises(ValueError, match=r"model\.joint_type of world 0: got 0; allow"):
        NewtonQDSolver(finalized(builder, device), robot)
    with pytest.raises(ValueError, match=r"model\.body_count: got 0; allowed: 2"):
        NewtonQDSolver(finalized(newton.ModelBuilder(), device), robot)


def test_a_second_free_body_has_its_mass_at_its_origin(
    tmp_path: Path, device: jax.Device
) -> None:
    """Newton's velocities of a free joint are those of the centre of mass."""
    off = '<inertial><origin xyz="0.2 0 0"/>'
    text = robot_text(
        '<link name="world"/>',
        link("a"),
        link("b").replace("<inertial>", off),
        *(joint(f"to_{name}", "floating", "world", name) for name in "ab"),
    )
    for given, refused in ((text, True), (text.replace(off, "<inertial>"), False)):
        robot = row(write(tmp_path, given), "a")
        builder = newton.ModelBuilder()
        builder.replicate(newton_builder(robot.urdf, False, 9.81), 1)
        model = finalized(builder, device)
        if refused:
            with pytest.raises(RobotDescriptionError, match="free body: got 'b', with"):
                NewtonQDSolver(model, robot)
        else:
            NewtonQDSolver(model, robot)


def test_bad_arguments_of_a_step(tmp_path: Path, device: jax.Device) -> None:
    robot = off_centre(tmp_path, ARM)
    loop = Loop(robot, 2, device)
    for dt in (0.0, -0.01, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=f"dt: got {dt!r}; allowed: .*above 0"):
            loop.step(dt)
    other = finalized(replicated(robot, 3), device).state()
    with pytest.raises(ValueError, match=r"state_in.joint_q: got shape \(24,\); al"):
        loop.solver.step(other, loop.next, loop.control, None, 0.01)
    with pytest.raises(ValueError, match=r"state_out.joint_q: got shape \(24,\); al"):
        loop.solver.step(loop.now, other, loop.control, None, 0.01)
    nothing: Any = None
    with pytest.raises(TypeError, match="state_out: got None; allowed: a new"):
        loop.solver.step(loop.now, nothing, loop.control, None, 0.01)
    with pytest.raises(TypeError, match="model: got None; allowed: a new"):
        NewtonQDSolver(nothing, robot)
    with pytest.raises(TypeError, match="robot: got None; allowed: a RobotSpec"):
        NewtonQDSolver(loop.solver.model, nothing)
    loop.control.joint_f = None
    with pytest.raises(ValueError, match=r"control.joint_f: got None; allowed: shape"):
        loop.step(0.01)


def test_a_tape_is_refused(tmp_path: Path, device: jax.Device) -> None:
    loop = Loop(off_centre(tmp_path), 1, device)
    with wp.Tape(), pytest.raises(RuntimeError, match=r"inside wp\.Tape"):
        loop.step(0.01)
