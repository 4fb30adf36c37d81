"""Prismatic joints against closed forms, and a planar root against a free one."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics_helpers import STANDING, batched_step, report, rollout
from urdf_text import joint, link, row, sphere, write

from newton_qd.assets import find_urdf
from newton_qd.envs.base import PhysicsEnv
from newton_qd.physics import reference
from newton_qd.physics.model import build_system, load_system
from newton_qd.physics.model.rest import raising_coordinate
from newton_qd.physics.system import PhysicsState, System
from newton_qd.robots import HOPPER, ROBOTS, Contact

MASS, GEAR, DAMPING, H = 2.0, 30.0, 5.0, 0.01  # of the cart, and its substep


def cart(folder: Path, axis: str, inside: str = "", **changes: Any) -> System:
    """A driven cart on one rail."""
    rail = joint("rail", "prismatic", "world", "cart", f'<axis xyz="{axis}"/>{inside}')
    text = f'<robot name="cart"><link name="world"/>{link("cart", mass=MASS)}{rail}'
    robot = row(
        write(folder, text + "</robot>"),
        "cart",
        actuators=(("rail", GEAR),),
        dt=H,
        substeps=1,
        **changes,
    )
    return build_system(robot, "float64")


def play(system: System, q: float, v: float, action: float, steps: int) -> PhysicsState:
    controls = np.full((steps, 1), action)
    return rollout(system)(np.array([q]), np.array([v]), controls)


def test_gear_and_damping(x64: None, tmp_path: Path) -> None:
    """v' = (v + h F / m) / (1 + h d / m): damping is implicit."""
    system = cart(tmp_path, "1 0 0", f'<dynamics damping="{DAMPING}"/>')
    path = play(system, 0.3, -1.0, 0.7, 100)
    q, v, expected = 0.3, -1.0, []
    for _ in range(100):
        v = (v + H * 0.7 * GEAR / MASS) / (1 + H * DAMPING / MASS)
        q += H * v
        expected.append((q, v))
    found = np.concatenate([path.q, path.v], axis=1)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("axis", [(0, 0, 1), (0, 0, -2), (3, -2, 6)])
def test_fall(x64: None, tmp_path: Path, axis: tuple[float, ...]) -> None:
    """Down its rail, whatever its direction: the scheme's parabola."""
    system = cart(tmp_path, " ".join(map(str, axis)))
    path = play(system, 0.1, 0.5, 0.0, 50)
    fall = -9.81 * axis[2] / np.linalg.norm(axis)
    n = np.arange(1, 51)
    np.testing.assert_allclose(path.v[:, 0], 0.5 + fall * H * n, rtol=1e-12)
    q = 0.1 + 0.5 * H * n + fall * H**2 * n * (n + 1) / 2
    np.testing.assert_allclose(path.q[:, 0], q, rtol=1e-11)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_limit(x64: None, tmp_path: Path, side: float) -> None:
    """Full gear is held at the stated distance past the end of the rail."""
    inside = f"""<dynamics damping="{10 * DAMPING}"/>
      <limit lower="-0.5" upper="0.5" effort="50" velocity="20"/>"""
    system = cart(tmp_path, "1 0 0", inside)
    path = play(system, 0.0, 0.0, side, 1000)
    stated = system.robot.material.limit_overshoot
    assert side * path.q[-1, 0] == pytest.approx(0.5 + stated, abs=1e-6)


def free_hopper(folder: Path) -> System:
    """The hopper with a free root; all of its masses in the plane."""
    text = find_urdf(HOPPER.urdf).read_text(encoding="utf-8")
    begin, end = text.index('<link name="world"/>'), text.index('<link name="torso">')
    text = (text[:begin] + text[end:]).replace("0.13 0.13 0.03", "0.13 0.0 0.03")
    robot = dataclasses.replace(HOPPER, urdf=write(folder, text))
    return build_system(robot, "float64")


def test_planar_root_moves_as_a_free_one(x64: None, tmp_path: Path) -> None:
    """Thrown against the ground and driven, over half a second with contacts."""
    planar, free = build_system(HOPPER, "float64"), free_hopper(tmp_path)
    rng = np.random.default_rng(0)
    steps = round(0.5 / HOPPER.dt)
    controls = rng.uniform(-1.0, 1.0, (steps, 3))
    angle, joints, rates = 0.2, np.array([-0.3, -0.5, 0.2]), rng.normal(size=3)
    q = np.concatenate([[0.4, 1.15, angle], joints])
    v = np.concatenate([[0.5, -1.0, 0.3], rates])
    turned = [0.0, np.sin(angle / 2), 0.0, np.cos(angle / 2)]
    q_free = np.concatenate([[0.4, 0.0, 1.15], turned, joints])
    v_free = np.concatenate([[0.5, 0.0, -1.0], [0.0, 0.3, 0.0], rates])
    ours = rollout(planar)(jnp.asarray(q), jnp.asarray(v), jnp.asarray(controls))
    theirs = rollout(free)(
        jnp.asarray(q_free), jnp.asarray(v_free), jnp.asarray(controls)
    )
    assert ours.normal_impulse[:, planar.feet].max() > 1.0
    np.testing.assert_allclose(ours.q[:, [0, 1]], theirs.q[:, [0, 2]], atol=1e-9)
    np.testing.assert_allclose(ours.q[:, 3:], theirs.q[:, 7:], atol=1e-9)
    np.testing.assert_allclose(ours.v[:, [0, 1, 2]], theirs.v[:, [0, 2, 4]], atol=1e-8)
    # the part of the angular impulse about y: the others turn about a moved centre
    felt, expected = ours.impulse[:, :, [0, 2, 4]], theirs.impulse[:, :, [0, 2, 4]]
    np.testing.assert_allclose(felt[:, 2:], expected, atol=1e-8)
    assert not np.any(felt[:, :2])
    report("largest difference of q", np.abs(ours.q[:, 3:] - theirs.q[:, 7:]).max())


@pytest.mark.parametrize("name", STANDING)
def test_far_away_everything_is_as_near(name: str) -> None:
    """Bitwise, in float32: what is computed moves with the root, slides included."""
    system = load_system(ROBOTS[name])
    rng = np.random.default_rng(0)
    q = np.tile(system.rest_q, (2, 1)).astype(np.float32)
    q[:, -system.nu :] += rng.normal(size=system.nu).astype(np.float32)
    raising = raising_coordinate(system)
    assert raising is not None
    q[:, raising[0]] -= 0.01 + reference.lowest_contact(system, q[0])
    q[1, 0] += 1024.0
    v = np.tile(rng.normal(size=system.nv).astype(np.float32), (2, 1))
    control = np.tile(rng.uniform(-1, 1, system.nu).astype(np.float32), (2, 1))
    _, v, impulse, normal, _ = map(np.asarray, batched_step(system)(q, v, control))
    assert np.any(normal != 0)
    for near, far in (v, impulse, normal):
        np.testing.assert_array_equal(near, far)


class Lowered(PhysicsEnv):
    """Does nothing, on a rail whose axis points down."""

    def observe(self, state: PhysicsState, action: jax.Array) -> dict[str, jax.Array]:
        return {"q": state.q}

    def outcome(self, before: PhysicsState, after: PhysicsState, action: Any) -> Any:
        zero = jnp.zeros((), after.q.dtype)
        return zero, zero, {}


def test_reset_puts_any_root_on_the_ground(tmp_path: Path) -> None:
    """The coordinate that raises the robot is found, and its sign."""
    down = joint("down", "prismatic", "world", "body", '<axis xyz="0 0 -1"/>')
    knee = joint("knee", "continuous", "body", "foot", '<axis xyz="0 1 0"/>')
    text = f"""<robot name="lift"><link name="world"/>{link("body")}
    {link("foot", sphere(0.1, "0 0 -1"))}{down}{knee}</robot>"""
    robot = row(
        write(tmp_path, text),
        "body",
        actuators=(("knee", 1.0),),
        contacts=(Contact("foot"),),
    )
    env = Lowered(robot, reset_noise_scale=0.5)
    reset = jax.jit(env.reset)
    for seed in range(3):
        down_by, angle = np.asarray(reset(jax.random.key(seed)).obs)
        assert abs(angle) > 0.01
        assert -down_by - np.cos(angle) - 0.1 == pytest.approx(0.0, abs=1e-6)


def test_reset_leaves_what_nothing_raises(tmp_path: Path) -> None:
    hinge = joint("hinge", "continuous", "world", "arm", '<axis xyz="0 1 0"/>')
    text = f"""<robot name="arm"><link name="world"/>
    {link("arm", sphere(0.1, "0 0 -1"))}{hinge}</robot>"""
    robot = row(
        write(tmp_path, text),
        "arm",
        actuators=(("hinge", 1.0),),
        contacts=(Contact("arm"),),
    )
    env = Lowered(robot, reset_noise_scale=0.5)
    assert jax.jit(env.reset)(jax.random.key(0)).obs.shape == (1,)
