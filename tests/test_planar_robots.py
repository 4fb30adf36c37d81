"""Halfcheetah, hopper and walker2d are those of the original, and come to rest.

Numbers are in the original's terms: a body's frame sits at its centre of mass, and a
capsule's length includes its caps.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
import pytest
from physics_helpers import passive, report, rollout

from newton_qd import physics
from newton_qd.assets import find_urdf
from newton_qd.physics import reference
from newton_qd.physics.model.description import read_description
from newton_qd.physics.system import JointKind
from newton_qd.robots import HALFCHEETAH, HOPPER, ROBOTS, WALKER2D, RobotSpec

Vector = tuple[float, float, float]
NAMES = ("halfcheetah", "hopper", "walker2d")


class Capsule(NamedTuple):
    """A collider, in its body: radius, end-to-end length, centre, axis."""

    radius: float
    length: float
    centre: Vector
    axis: Vector


class Part(NamedTuple):
    """A body: mass, moment of inertia, default position and rotation, colliders."""

    mass: float
    inertia: float
    position: Vector
    w: float
    y: float
    capsules: tuple[Capsule, ...]


class Hinge(NamedTuple):
    """A joint: parent, limits [degrees], damping, gear."""

    parent: str
    lower: float
    upper: float
    damping: float
    gear: float


def upright(radius: float, length: float, height: float = 0.0) -> tuple[Capsule, ...]:
    return (Capsule(radius, length, (0, 0, height), (0, 0, 1)),)


def thin(length: float, centre: Vector, axis: Vector) -> Capsule:
    return Capsule(0.046, length, centre, axis)


TORSO = (3.6651914, 1.0)
THIGH = (4.0578904, 1.0)
LEG = (2.7813568, 1.0)
SHIN_AXIS = (-0.564642, 0, 0.825336)
PARTS: dict[str, dict[str, Part]] = {
    "halfcheetah": {
        "torso": Part(
            9.457333,
            0.944797,
            (0, 0, 0.583585),
            1,
            0,
            (
                thin(1.092, (0, 0, 0), (1, 0, 0)),
                thin(0.392, (0.6, 0, 0.1), (0.764329, 0, 0.644827)),
            ),
        ),
        "bthigh": Part(
            2.335527,
            0.02963628,
            (-0.5, 0, 0.583585),
            0.991235,
            0.132113,
            (thin(0.382, (0.1, 0, -0.13), (0.611858, 0, -0.790968)),),
        ),
        "bshin": Part(
            2.402003,
            0.032029107,
            (-0.411063, 0, 0.300407),
            0.991235,
            0.132113,
            (thin(0.392, (-0.14, 0, -0.07), (-0.896406, 0, -0.443234)),),
        ),
        "bfoot": Part(
            1.6574708,
            0.011705612,
            (-0.717956, 0, 0.238628),
            0.973951,
            0.22676,
            (thin(0.28, (0.03, 0, -0.097), (-0.266731, 0, 0.963771)),),
        ),
        "fthigh": Part(
            2.1759844,
            0.024391336,
            (0.5, 0, 0.583585),
            0.997189,
            -0.0749297,
            (thin(0.358, (-0.07, 0, -0.12), (0.49688, 0, 0.867819)),),
        ),
        "fshin": Part(
            1.8170134,
            0.014954625,
            (0.397437, 0, 0.325359),
            0.987622,
            -0.15685,
            (thin(0.304, (0.065, 0, -0.09), SHIN_AXIS),),
        ),
        "ffoot": Part(
            1.3383855,
            0.0067111105,
            (0.576808, 0, 0.194492),
            0.987622,
            -0.15685,
            (thin(0.232, (0.045, 0, -0.07), SHIN_AXIS),),
        ),
    },
    "hopper": {
        "torso": Part(*TORSO, (0, 0, 1.25), 1, 0, upright(0.05, 0.5)),
        "thigh": Part(*THIGH, (0, 0, 1.05), 1, 0, upright(0.05, 0.55, -0.225)),
        "leg": Part(*LEG, (0, 0, 0.35), 1, 0, upright(0.04, 0.58)),
        "foot": Part(
            5.3155746,
            1.0,
            (0.13, 0.13, 0.13),
            1,
            0,
            (Capsule(0.06, 0.51, (-0.065, -0.13, -0.03), (1, 0, 0)),),
        ),
    },
    "walker2d": {
        "torso": Part(*TORSO, (0, 0, 1.19), 1, 0, upright(0.05, 0.5)),
        **{
            f"{part}{side}": row
            for side in ("", "_left")
            for part, row in {
                "thigh": Part(*THIGH, (0, 0, 0.99), 1, 0, upright(0.05, 0.55, -0.225)),
                "leg": Part(*LEG, (0, 0, 0.29), 1, 0, upright(0.04, 0.58)),
                "foot": Part(
                    3.1667254,
                    1.0,
                    (0.2, 0.2, 0.14),
                    1,
                    0,
                    (Capsule(0.06, 0.32, (-0.1, -0.2, -0.1), (1, 0, 0)),),
                ),
            }.items()
        },
    },
}
HINGES: dict[str, dict[str, Hinge]] = {
    "halfcheetah": {
        "bthigh": Hinge("torso", -29.793806, 60.16057, 0, 120),
        "bshin": Hinge("bthigh", -44.97719, 44.97719, 0, 90),
        "bfoot": Hinge("bshin", -22.918312, 44.97719, 0, 60),
        "fthigh": Hinge("torso", -57.29578, 40.107044, 0, 120),
        "fshin": Hinge("fthigh", -68.75494, 49.84733, 0, 60),
        "ffoot": Hinge("fshin", -28.64789, 28.64789, 0, 30),
    },
    "hopper": {
        "thigh_joint": Hinge("torso", -150, 0, 20, 200),
        "leg_joint": Hinge("thigh", -150, 0, 20, 200),
        "foot_joint": Hinge("leg", -45, 45, 20, 200),
    },
    "walker2d": {
        f"{part}{side}_joint": Hinge(parent, lower, upper, 20, 100)
        for side in ("", "_left")
        for part, parent, lower, upper in (
            ("thigh", "torso", -150, 0),
            ("leg", f"thigh{side}", -150, 0),
            ("foot", f"leg{side}", -45, 45),
        )
    },
}
ROWS = {  # control step, gravity, friction of a pair, feet
    "halfcheetah": (0.05, 9.81, 0.6, ("ffoot", "bfoot")),
    "hopper": (0.008, 9.81, 0.9, ("foot",)),
    "walker2d": (0.008, 9.81, 0.9, ("foot", "foot_left")),
}


@pytest.mark.parametrize("name", NAMES)
def test_bodies(name: str) -> None:
    """Masses, inertias and the default pose of every body, to the last digit."""
    system, parts = physics.load_system(ROBOTS[name]), PARTS[name]
    assert system.body_names == ("slide_x", "slide_z", *parts)
    assert not system.mass[:2].any() and not system.inertia[:2].any()
    frames = reference.body_frames(system, system.rest_q)
    for body, part in enumerate(parts.values(), start=2):
        assert system.mass[body] == part.mass
        np.testing.assert_allclose(system.inertia[body], part.inertia * np.eye(3))
        centre = reference.compose(frames[body], np.append(system.com[body], [0] * 4))
        np.testing.assert_allclose(centre[:3], part.position, atol=1e-6)
        turned = (part.w, 0, part.y, 0)
        np.testing.assert_allclose(frames[body, [6, 3, 4, 5]], turned, atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_joints(name: str) -> None:
    system, hinges = physics.load_system(ROBOTS[name]), HINGES[name]
    assert system.joint_names == ("root_x", "root_z", "root_pitch", *hinges)
    kinds = [JointKind.PRISMATIC] * 2 + [JointKind.REVOLUTE] * (1 + len(hinges))
    assert system.joint_kind.tolist() == kinds
    up = 1.0 if name == "halfcheetah" else -1.0
    axes = [[1, 0, 0], [0, 0, 1], [0, 1, 0]] + [[0, up, 0]] * len(hinges)
    np.testing.assert_allclose(system.joint_axis, axes, atol=1e-15)
    rows = list(hinges.values())
    parents = [system.body_names[parent] for parent in system.parent[3:]]
    assert parents == [row.parent for row in rows]
    unlimited = [-np.inf] * 3
    lower = np.concatenate([unlimited, np.radians([row.lower for row in rows])])
    upper = np.concatenate([unlimited, -np.radians([row.upper for row in rows])])
    np.testing.assert_allclose(system.limit_lower, lower, atol=1e-6)
    np.testing.assert_allclose(-system.limit_upper, upper, atol=1e-6)
    assert system.damping.tolist() == [0, 0, 0, *(row.damping for row in rows)]
    assert system.control_dof.tolist() == list(range(3, system.nv))
    assert system.gear.tolist() == [row.gear for row in rows]
    assert not system.armature.any() and not system.stiffness.any()


@pytest.mark.parametrize("name", NAMES)
def test_colliders(name: str) -> None:
    bodies = read_description(find_urdf(ROBOTS[name].urdf)).bodies
    for link, part in PARTS[name].items():
        body = bodies[link]
        for shape, capsule in zip(body.shapes, part.capsules, strict=True):
            radius, half, _ = shape.size
            assert shape.kind == "capsule" and radius == capsule.radius
            assert 2 * (half + radius) == pytest.approx(capsule.length, abs=1e-12)
            centre = shape.frame[:3] - body.link.com
            np.testing.assert_allclose(centre, capsule.centre, atol=1e-12)
            axis = reference.rotation_matrix(shape.frame[3:])[:, 2]
            np.testing.assert_allclose(axis, capsule.axis, atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_contacts(name: str) -> None:
    """Both ends of every capsule may touch the ground."""
    system = physics.load_system(ROBOTS[name])
    expected = []
    for body, part in enumerate(PARTS[name].values(), start=2):
        for capsule in part.capsules:
            reach = (capsule.length / 2 - capsule.radius) * np.array(capsule.axis)
            centre = system.com[body] + np.array(capsule.centre)
            expected += [
                (body, capsule.radius, *(centre + end * reach)) for end in (1, -1)
            ]
    found = np.column_stack(
        [system.contact_body, system.contact_radius, system.contact_position]
    )[system.ground_contacts]
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_rows(name: str) -> None:
    robot = ROBOTS[name]
    dt, gravity, friction, feet = ROWS[name]
    assert (robot.dt, robot.gravity, robot.feet) == (dt, gravity, feet)
    assert robot.material.friction == friction
    assert robot.substeps is not None and robot.dt / robot.substeps <= 0.005


SECONDS, WORLDS = 30, 8


@pytest.mark.parametrize("robot", [HALFCHEETAH, HOPPER, WALKER2D], ids=lambda r: r.name)
def test_without_actuation_it_comes_to_rest(robot: RobotSpec) -> None:
    """From eight poses near the default one: it falls, and lies still."""
    system = physics.load_system(robot)
    rng = np.random.default_rng(0)
    q = np.tile(system.rest_q, (WORLDS, 1))
    q[1:, 1] += rng.uniform(-0.1, 0.1, WORLDS - 1)
    q[1:, 3:] -= rng.uniform(0.0, 0.1, (WORLDS - 1, system.nu))
    start, still = q.astype(np.float32), np.zeros((WORLDS, system.nv), np.float32)
    controls = passive(system, round(SECONDS / robot.dt))
    run = jax.jit(jax.vmap(rollout(system), (0, 0, None)))
    path = run(start, still, controls)
    last = round(1 / robot.dt)
    speed = np.abs(np.asarray(path.v)[:, -last:]).max()
    rest = np.asarray(path.q, np.float64)[:, -1]
    heights = [reference.lowest_contact(system, row) for row in rest]
    report("lowest and highest of the worlds [mm]", (min(heights), max(heights)))
    report("largest speed of the last second [m/s or rad/s]", speed)
    assert np.abs(heights).max() < 5e-3
    assert speed < 1e-3
