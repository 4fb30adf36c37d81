"""Pendulums, acrobot, reachers, swimmer and the lying humanoid are the original's.

Numbers are in the original's terms: a body's frame sits at its centre of mass, and a
capsule's length includes its caps. Every inertia is 1 kg m^2 about every axis.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import urdf_text
from physics_helpers import variant

from newton_qd import physics
from newton_qd.assets import find_urdf
from newton_qd.brax_views import BraxViewsWrapper
from newton_qd.envs import Acrobot
from newton_qd.envs.joints import joint_chains
from newton_qd.physics import reference
from newton_qd.physics.model.description import read_description
from newton_qd.physics.model.elements import Shape
from newton_qd.physics.model.rest import raising_coordinate
from newton_qd.physics.model.xml_reader import RobotDescriptionError
from newton_qd.physics.system import JointKind
from newton_qd.robots import HUMANOID_STANDUP, REACHERANGLE, ROBOTS

Vector = tuple[float, float, float]


class Part(NamedTuple):
    """A body: mass, default position, and collider: radius, length, centre, axis."""

    mass: float
    position: Vector
    radius: float
    length: float
    centre: Vector
    axis: Vector


class Model(NamedTuple):
    """A robot: bodies; joints with axis, gear, limits and damping; steps; gravity."""

    parts: dict[str, Part]
    hinges: dict[str, tuple[Vector, float, float, float]]
    dt: float
    gravity: float


X, Y, Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)
DOWN_Y = (0, -1, 0)
ORIGIN = (0, 0, 0)
CART = Part(10.471975, (0, 0, 0.1), 0.1, 0.4, ORIGIN, (0, -1, 0))
FREE = np.inf


def pole(mass: float, height: float, length: float) -> Part:
    return Part(mass, (0, 0, height), 0.049, length, ORIGIN, Z)


LIGHT = 0.69800085
ARM = {
    "body0": Part(0.035604715, (0, 0, 0.01), 0.01, 0.12, (0.05, 0, 0), X),
    "body1": Part(0.035604715, (0.1, 0, 0.01), 0.01, 0.12, (0.05, 0, 0), X),
}
MODELS = {
    "inverted_pendulum": Model(
        {"cart": CART, "pole": pole(5.0185914, 0.4, LIGHT)},
        {"slider": (X, 100, FREE, 0), "hinge": (Y, 0, FREE, 0)},
        0.04,
        9.81,
    ),
    "inverted_double_pendulum": Model(
        {
            "cart": CART,
            "pole": pole(5.0185914, 0.4, LIGHT),
            "pole2": pole(5.0185914, 1.0, LIGHT),
        },
        {
            "slider": (X, 500, FREE, 0),
            "hinge": (Y, 0, FREE, 0),
            "hinge2": (Y, 0, FREE, 0),
        },
        0.05,
        9.81,
    ),
    "acrobot": Model(
        {"pole": pole(2.5, 1.4, 1.0), "pole2": pole(2.5, 0.5, 1.0)},
        {"hinge": (Y, 0, FREE, 0), "hinge2": (Y, 25, FREE, 0)},
        0.01,
        9.81,
    ),
    "reacher": Model(
        ARM, {"joint0": (Z, 25, FREE, 0), "joint1": (Z, 25, FREE, 0)}, 0.02, 9.81
    ),
    "reacherangle": Model(
        ARM, {"joint0": (Z, 20, 180, 10), "joint1": (Z, 20, 180, 10)}, 0.02, 9.81
    ),
    "ur5e": Model(
        {
            "shoulder_link": Part(
                1.0, (0, 0, 0.163), 0.059452087, 0.13365984, (0, 0.06682992, 0), DOWN_Y
            ),
            "upper_arm_link": Part(
                1.0, (0, 0.138, 0.163), 0.059686188, 0.54464495, (0, 0, 0.21287039), Z
            ),
            "forearm_link": Part(
                1.0, (0, 0.008, 0.588), 0.05584339, 0.48926497, (0, 0, 0.1851804), Z
            ),
            "wrist_1_link": Part(
                1.0,
                (0, 0.008, 0.98),
                0.038744934,
                0.10467607,
                (0, 0.10467607, 0),
                DOWN_Y,
            ),
            "wrist_2_link": Part(
                1.0, (0, 0.135, 0.98), 0.038792014, 0.1046881, (0, 0, 0.05234405), Z
            ),
            "wrist_3_link": Part(
                1.0,
                (0, 0.135, 1.08),
                0.017250156,
                0.08051565,
                (0, -0.040257826, 0),
                DOWN_Y,
            ),
        },
        {
            f"{joint}_joint": (axis, 100, FREE, 50)
            for joint, axis in (
                ("shoulder_pan", Z),
                ("shoulder_lift", Y),
                ("elbow", Y),
                ("wrist_1", Y),
                ("wrist_2", Z),
                ("wrist_3", Y),
            )
        },
        0.02,
        9.81,
    ),
    "swimmer": Model(
        {
            name: Part(0.35604718, (x, 0, 0.1), 0.1, 1.2, ORIGIN, (-1, 0, 0))
            for x, name in enumerate(("torso", "mid", "back"))
        },
        {"rot2": (Z, 30, 100, 10), "rot3": (Z, 30, 100, 10)},
        0.04,
        0.0,
    ),
}


@pytest.mark.parametrize("name", MODELS)
def test_bodies(name: str) -> None:
    system, parts = physics.load_system(ROBOTS[name]), MODELS[name].parts
    frames = reference.body_frames(system, system.rest_q)
    files = read_description(find_urdf(ROBOTS[name].urdf)).bodies
    for link, part in parts.items():
        body = system.body_names.index(link)
        assert system.mass[body] == part.mass
        np.testing.assert_array_equal(system.inertia[body], np.eye(3))
        centre = reference.compose(frames[body], np.append(system.com[body], [0] * 4))
        np.testing.assert_allclose(centre[:3], part.position, atol=1e-12)
        is_part(files[link].shapes[0], part, system.com[body])


def is_part(shape: Shape, part: Part, com: np.ndarray) -> None:
    assert shape.kind == "capsule"
    sizes = [part.radius, part.length / 2 - part.radius]
    np.testing.assert_allclose(shape.size[:2], sizes, rtol=1e-9)
    np.testing.assert_allclose(shape.frame[:3] - com, part.centre, atol=1e-12)
    along = reference.rotation_matrix(shape.frame[3:])[:, 2]
    np.testing.assert_allclose(along, part.axis, atol=1e-12)


@pytest.mark.parametrize("name", MODELS)
def test_joints(name: str) -> None:
    model, system = MODELS[name], physics.load_system(ROBOTS[name])
    gears = dict(ROBOTS[name].actuators)
    assert (system.robot.dt, system.robot.gravity) == (model.dt, model.gravity)
    assert not system.contact_body.size
    for joint, (axis, gear, limit, damping) in model.hinges.items():
        body = system.joint_names.index(joint)
        dof = system.v_start[body]
        kind = JointKind.PRISMATIC if joint == "slider" else JointKind.REVOLUTE
        assert system.joint_kind[body] == kind
        np.testing.assert_allclose(system.joint_axis[body], axis, atol=1e-15)
        assert gears.get(joint, 0) == gear
        ends = [system.limit_lower[dof], system.limit_upper[dof]]
        np.testing.assert_allclose(np.degrees(ends), [-limit, limit], rtol=1e-12)
        assert system.damping[dof] == damping


def test_acrobot_hangs_from_a_mount() -> None:
    env: Any = BraxViewsWrapper(Acrobot())
    qp, at = env.fixed_state().qp, env.sys.body.index["cart"]
    assert env.sys.num_joint_dof == 2
    np.testing.assert_allclose(qp.pos[at], (0, 0, 1.85), atol=1e-7)


@pytest.mark.parametrize("name", ["reacher", "reacherangle"])
def test_target_is_a_root_that_stays(name: str) -> None:
    """Two roots in a world: the arm moves the target by not one bit."""
    system = physics.load_system(ROBOTS[name])
    assert [system.body_names[b] for b in np.flatnonzero(system.parent < 0)] == [
        "body0",
        "target_slide",
    ]
    mass = reference.mass_matrix(system, np.arange(4.0))
    assert not mass[:2, 2:].any()
    (shape,) = read_description(find_urdf(ROBOTS[name].urdf)).bodies["target"].shapes
    assert (shape.kind, shape.size[0]) == ("sphere", 0.009)


def test_a_servo_holds_its_angle() -> None:
    """torque = gear (target - angle), with the spring in the implicit part."""
    system = physics.load_system(REACHERANGLE)
    assert system.stiffness.tolist() == [20.0, 20.0, 0.0, 0.0]
    assert not system.spring_rest.any()
    with pytest.raises(
        RobotDescriptionError, match=r"servos: got 'elbow', .* joint0, joi"
    ):
        variant(REACHERANGLE, "float32", servos=("elbow",))


# The original's default pose, six digits; x is counted from the torso here.
LYING = {
    "torso": ((0, 0, 0.09), (0.707107, 0, -0.707107, 0)),
    "lwaist": ((0.255052, 0, 0.104874), (0.55557, 0, -0.83147, 0)),
    "right_thigh": ((0.444447, -0.1, 0.183325), (0.59131, 0, -0.806445, 0)),
    "left_shin": ((0.82955, 0.09, 0.295884), (0.75184, 0, -0.659346, 0)),
    "right_lower_arm": (
        (0.157279, -0.387279, 0.037279),
        (0.865018, 0.26865, -0.327718, -0.26865),
    ),
}


def test_the_humanoid_lies_on_its_back() -> None:
    system = physics.load_system(HUMANOID_STANDUP)
    frames = reference.body_frames(system, system.rest_q)
    for name, (position, rotation) in LYING.items():
        body = system.body_names.index(name)
        centre = reference.compose(frames[body], np.append(system.com[body], [0] * 4))
        np.testing.assert_allclose(centre[:3], position, atol=2e-6)
        np.testing.assert_allclose(frames[body, [6, 3, 4, 5]], rotation, atol=2e-6)
    names = [system.body_names[body] for body in system.contact_body]
    expected = {"torso": 5, "right_shin": 2, "left_shin": 2}
    expected |= {"right_lower_arm": 3, "left_lower_arm": 3}
    assert {name: names.count(name) for name in names} == expected
    with pytest.raises(
        RobotDescriptionError, match=r"rest_rotation: got .*no free root"
    ):
        variant(REACHERANGLE, "float32", rest_rotation=(1.0, 0.0, 0.0))


def test_a_hinge_of_the_world_is_a_joint_and_a_slide_is_none() -> None:
    acrobot, cart = (
        physics.load_system(ROBOTS[name])
        for name in ("acrobot", "inverted_double_pendulum")
    )
    assert joint_chains(acrobot) == [[0], [1]]
    assert joint_chains(cart) == [[1], [2]]
    chains = joint_chains(physics.load_system(ROBOTS["humanoid"]))
    assert max(map(len, chains)) == 3  # of a hip, whose parents are first
    assert all(chain == sorted(chain) for chain in chains)


def test_the_nearest_vertical_slide_raises_the_torso(tmp_path: Path) -> None:
    limit = '<axis xyz="0 0 -1"/><limit lower="-1" upper="1"/>'
    text = urdf_text.robot_text(
        *('<link name="world"/>', urdf_text.link("lift"), urdf_text.link("fork")),
        urdf_text.joint("far", "prismatic", "world", "lift", limit),
        urdf_text.joint("near", "prismatic", "lift", "fork", limit),
    )
    for torso, coordinate in (("lift", 0), ("fork", 1)):
        system = urdf_text.built(tmp_path, text, torso)
        assert raising_coordinate(system) == (coordinate, -1.0)
