"""The humanoid's file and row are the original's numbers, stated here as data."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from physics_helpers import batched_step, report, rollout, variant

from newton_qd.assets import find_urdf
from newton_qd.physics import load_system, reference
from newton_qd.physics.model.description import read_description
from newton_qd.physics.system import System
from newton_qd.robots import HUMANOID

# Mass, and the colliders as they lie about the centre of mass: radius, end-to-end
# length, axis, position; a sphere has no axis.
X, Y, Z = np.eye(3)
BODIES = {
    "torso": (
        8.907463,
        [
            (0.07, 0.28, Y, (0, 0, 0)),
            (0.09, 0.18, None, (0, 0, 0.19)),
            (0.06, 0.24, Y, (-0.01, 0, -0.12)),
        ],
    ),
    "lwaist": (2.2619467, [(0.06, 0.24, Y, (0, 0, 0))]),
    "pelvis": (6.6161942, [(0.09, 0.32, Y, (-0.02, 0, 0))]),
}
SIDES = {"right": -1.0, "left": 1.0}
for side, sign in SIDES.items():
    shin = [
        (0.049, 0.398, -Z, (0, 0, -0.15)),
        (0.075, 0.15, None, (0, 0, -0.35)),
    ]
    thigh = (0, -0.01 * sign, -0.34)
    arm, elbow = (0.16, 0.16 * sign, -0.16), (1, -sign, 1)
    BODIES |= {
        f"{side}_thigh": (
            4.751751,
            [(0.06, 0.46014702, thigh, (0, -0.005 * sign, -0.17))],
        ),
        f"{side}_shin": (4.522842, shin),
        f"{side}_upper_arm": (
            1.6610805,
            [(0.04, 0.35712814, arm, (0.08, 0.08 * sign, -0.08))],
        ),
        f"{side}_lower_arm": (
            1.2295402,
            [
                (0.031, 0.33912814, elbow, (0.09, -0.09 * sign, 0.09)),
                (0.04, 0.08, None, (0.18, -0.18 * sign, 0.18)),
            ],
        ),
    }
# Joints in the order of the original: parent, child, anchor about either's centre of
# mass, and for every axis its name, direction, limits and rest angle [deg], gear.
JOINTS = [
    (
        *("torso", "lwaist", (-0.01, 0, -0.195), (0, 0, 0.065)),
        [
            ("abdomen_z", Z, (-45, 45), 0, 350),
            ("abdomen_y", Y, (-75, 30), -22.5, 350),
        ],
    ),
    (
        *("lwaist", "pelvis", (0, 0, -0.065), (0, 0, 0.1)),
        [("abdomen_x", X, (-35, 35), 0, 350)],
    ),
]
for side, sign in SIDES.items():
    hip = [("x", X, (-10, 10), 0), ("y", Y, (-30, 70), 20), ("z", Z, (-10, 10), 0)]
    JOINTS += [
        (
            *("pelvis", f"{side}_thigh", (0, 0.1 * sign, -0.04), (0, 0, 0)),
            [(f"{side}_hip_{name}", *rest, 350) for name, *rest in hip],
        ),
        (
            f"{side}_thigh",
            f"{side}_shin",
            (0, -0.01 * sign, -0.383),
            (0, 0, 0.02),
            [(f"{side}_knee", -Y, (-160, -2), -25, 350)],
        ),
    ]
for side, sign in SIDES.items():
    limits = (-60, 85) if side == "left" else (-85, 60)
    first = np.array([2, -sign, 1]) / np.sqrt(6)
    second = np.array([0, sign, 1]) / np.sqrt(2)
    bend = np.array([0, -1, -sign]) / np.sqrt(2)
    rest = 12.5 * sign
    JOINTS += [
        (
            *("torso", f"{side}_upper_arm", (0, 0.17 * sign, 0.06), (0, 0, 0)),
            [
                (f"{side}_shoulder1", first, limits, rest, 100),
                (f"{side}_shoulder2", second, limits, rest, 100),
            ],
        ),
        (
            f"{side}_upper_arm",
            f"{side}_lower_arm",
            (0.18, 0.18 * sign, -0.18),
            (0, 0, 0),
            [(f"{side}_elbow", bend, (-90, 50), -20, 100)],
        ),
    ]
AXES = [axis for *_, axes in JOINTS for axis in axes]
# Centre of mass and rotation (wxyz) in the default pose, six digits, as printed by
# the original.
DEFAULT_POSE = {
    "torso": ((0, 0, 1.24392), (1, 0, 0, 0)),
    "lwaist": ((0.0148744, 0, 0.988866), (0.980785, 0, -0.19509, 0)),
    "pelvis": ((0.0780172, 0, 0.836426), (0.980785, 0, -0.19509, 0)),
    "right_thigh": ((0.0933245, -0.1, 0.799471), (0.999762, 0, -0.0218149, 0)),
    "right_shin": ((0.102377, -0.09, 0.398358), (0.980785, 0, 0.19509, 0)),
    "left_thigh": ((0.0933245, 0.1, 0.799471), (0.999762, 0, -0.0218149, 0)),
    "left_shin": ((0.102377, 0.09, 0.398358), (0.980785, 0, 0.19509, 0)),
    "right_upper_arm": (
        (0, -0.17, 1.30392),
        (0.988148, -0.0815183, 0.0254997, -0.127546),
    ),
    "right_lower_arm": (
        (0.116471, -0.4157, 1.15139),
        (0.954344, -0.0677498, 0.136435, -0.256951),
    ),
    "left_upper_arm": (
        (0, 0.17, 1.30392),
        (0.988148, 0.0815183, 0.0254997, 0.127546),
    ),
    "left_lower_arm": (
        (0.116471, 0.4157, 1.15139),
        (0.954344, 0.0677498, 0.136435, 0.256951),
    ),
}


@pytest.fixture(scope="module")
def humanoid() -> System:
    return load_system(HUMANOID)


def turn(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' rotation matrix."""
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


def original_poses(
    angles: dict[str, float],
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Centre of mass about the torso's and rotation of every body, as the table says.

    Axes turn in order, each carried along by those before it.
    """
    poses = {"torso": (np.zeros(3), np.eye(3))}
    for parent, child, parent_anchor, child_anchor, axes in JOINTS:
        at, rotation = poses[parent]
        anchor = at + rotation @ parent_anchor
        for name, axis, *_ in axes:
            rotation = rotation @ turn(axis, angles[name])
        poses[child] = (anchor - rotation @ child_anchor, rotation)
    return poses


def poses_of(system: System, q: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Centre of mass and rotation of every body with mass."""
    found = {}
    for name, frame, com in zip(
        system.body_names, reference.body_frames(system, q), system.com, strict=True
    ):
        rotation = reference.rotation_matrix(frame[3:])
        if name in BODIES:
            found[name] = (frame[:3] + rotation @ com, rotation)
    return found


def test_default_pose_is_the_printed_one(humanoid: System) -> None:
    frames = reference.body_frames(humanoid, humanoid.rest_q)
    poses = poses_of(humanoid, humanoid.rest_q)
    for name, (position, rotation) in DEFAULT_POSE.items():
        frame = frames[humanoid.body_names.index(name)]
        for found, printed in (
            (poses[name][0], position),
            (frame[[6, 3, 4, 5]], rotation),
        ):
            np.testing.assert_allclose(found, printed, rtol=5e-6, atol=1e-6)


def test_joints_turn_about_the_axes_of_the_original_in_order(humanoid: System) -> None:
    rng = np.random.default_rng(0)
    rest = {name: np.radians(angle) for name, _, _, angle, _ in AXES}
    anywhere = [dict.fromkeys(rest, 0.0) | {name: 1.0} for name in rest]
    anywhere += [{name: rng.uniform(-1, 1) for name in rest} for _ in range(20)]
    for index, angles in enumerate([rest, *anywhere]):
        q = np.array(humanoid.rest_q)
        for name, angle in angles.items():
            q[humanoid.q_start[humanoid.joint_names.index(name)]] = angle
        if index == 0:
            np.testing.assert_allclose(q, humanoid.rest_q, atol=1e-15)
        found = poses_of(humanoid, q)
        for name, (position, rotation) in original_poses(angles).items():
            at = found[name][0] - found["torso"][0]
            np.testing.assert_allclose(at, position, atol=1e-9)
            np.testing.assert_allclose(found[name][1], rotation, atol=1e-9)


def test_masses_and_inertias(humanoid: System) -> None:
    assert [name for name in humanoid.body_names if name in BODIES] == [*DEFAULT_POSE]
    assert humanoid.total_mass == pytest.approx(42.116, abs=5e-4)
    for name, mass, inertia in zip(
        humanoid.body_names, humanoid.mass, humanoid.inertia, strict=True
    ):
        solid = name in BODIES
        assert mass == (BODIES[name][0] if solid else 0.0)
        np.testing.assert_array_equal(inertia, np.eye(3) * solid)
    assert not humanoid.armature.any() and not humanoid.stiffness.any()


def test_gears_limits_and_damping(humanoid: System) -> None:
    assert (humanoid.nb, humanoid.nq, humanoid.nv, humanoid.nu) == (18, 24, 23, 17)
    gears = [(name, gear) for name, *_, gear in AXES]
    # action order of the original: trunk z, y, x, then legs, then arms
    assert list(HUMANOID.actuators) == gears
    limits = np.stack([humanoid.limit_lower, humanoid.limit_upper], axis=1)
    expected = np.radians([axis[2] for axis in AXES])
    np.testing.assert_allclose(limits[humanoid.control_dof], expected, rtol=1e-12)
    assert humanoid.damping.tolist() == [0.0] * 6 + [30.0] * 17
    assert (HUMANOID.dt, HUMANOID.gravity) == (0.015, 9.81)
    assert humanoid.h <= 7.5e-3


@pytest.mark.parametrize("name", BODIES)
def test_colliders(name: str) -> None:
    body = read_description(find_urdf("humanoid.urdf")).bodies[name]
    for shape, (radius, length, axis, position) in zip(
        body.shapes, BODIES[name][1], strict=True
    ):
        np.testing.assert_allclose(shape.frame[:3] - body.link.com, position, atol=1e-9)
        assert shape.kind == ("sphere" if axis is None else "capsule")
        assert shape.size[0] == pytest.approx(radius, rel=1e-12)
        if axis is not None:
            assert shape.size[1] == pytest.approx(length / 2 - radius, rel=1e-9)
            along = reference.rotation_matrix(shape.frame[3:])[:, 2]
            cosine = along @ np.array(axis) / np.linalg.norm(axis)
            assert abs(cosine) == pytest.approx(1.0, abs=1e-12)


def test_only_the_shins_touch(humanoid: System) -> None:
    names = [humanoid.body_names[body] for body in humanoid.contact_body]
    assert names == ["right_shin"] * 2 + ["left_shin"] * 2
    centres = humanoid.contact_position - humanoid.com[humanoid.contact_body]
    expected = [(0, 0, 0), (0, 0, -0.35)] * 2
    np.testing.assert_allclose(centres, expected, atol=1e-12)
    assert humanoid.contact_radius.tolist() == [0.049, 0.075] * 2
    feet = [humanoid.body_names[foot] for foot in humanoid.feet]
    assert feet == ["left_shin", "right_shin"]
    assert humanoid.body_names[humanoid.torso] == "torso"


def at_limits(system: System) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates (34, nq) in the air with one joint on a limit; dofs; directions."""
    dofs = np.repeat(system.control_dof, 2)
    outward = np.tile([-1.0, 1.0], system.nu)
    q = np.tile(system.rest_q, (len(dofs), 1))
    q[:, 2] += 5.0
    limits = np.where(outward > 0, system.limit_upper[dofs], system.limit_lower[dofs])
    q[np.arange(len(dofs)), dofs + 1] = limits
    return q, dofs, outward


def controls(system: System, outward: np.ndarray, size: float) -> np.ndarray:
    """Actions (34, nu) that push each joint outward."""
    rows = np.arange(len(outward))
    found = np.zeros((len(outward), system.nu))
    found[rows, rows // 2] = size * outward
    return found


def test_a_pose_on_a_limit_feels_less_than_a_fiftieth_of_the_gear() -> None:
    system = variant(HUMANOID, "float32", gravity=0.0)
    q, dofs, outward = at_limits(system)
    push = controls(system, outward, 0.02)
    v = np.zeros((len(q), system.nv))
    _, v, *_ = batched_step(system)(*(x.astype(np.float32) for x in (q, v, push)))
    assert np.all(np.asarray(v)[np.arange(len(q)), dofs] * outward > 0)


def test_full_gear_holds_a_joint_at_the_stated_angle_past_its_limit() -> None:
    system = variant(HUMANOID, "float32", gravity=0.0)
    q, dofs, outward = at_limits(system)
    start = np.tile(system.rest_q, (len(q), 1))
    start[:, 2] += 5.0
    pushes = np.repeat(controls(system, outward, 1.0)[:, None], 150, axis=1)
    v = np.zeros((len(q), system.nv))
    states = jax.vmap(rollout(system))(
        *(x.astype(np.float32) for x in (start, v, pushes))
    )
    rows = np.arange(len(q))
    limits = q[rows, dofs + 1]
    past = (np.asarray(states.q)[rows, :, dofs + 1] - limits[:, None]) * outward[
        :, None
    ]
    report("angle past a limit, moving, held", (past.max(), past[:, -1].max()))
    stated = HUMANOID.material.limit_overshoot
    assert past[:, -1].max() < 1.001 * stated
    assert past[:, -1].min() > 0.9 * stated
    assert past.max() < 3 * stated
