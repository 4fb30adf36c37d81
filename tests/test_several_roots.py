"""Robots of several free bodies: what one of them does leaves the others right."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from urdf_text import joint, link, row, write

from newton_qd import physics
from newton_qd.envs.locomotion import Locomotion
from newton_qd.physics import SoftWallWarning, load_system, reference
from newton_qd.physics.model.xml_reader import RobotDescriptionWarning
from newton_qd.physics.system import System
from newton_qd.robots import Contact
from newton_qd.scenes import Scene

UNEVEN = ".02 .01 -.03", ".01 .02 .015"
"""Centre of mass of a ball that is not its centre [m], and moments [kg m^2]."""
EVEN = "0 0 0", ".01 .01 .01"


def loose(name: str, mass: float, inside: tuple[str, str] = UNEVEN) -> str:
    """A ball that moves freely."""
    com, moments = inside
    ixx, iyy, izz = moments.split()
    inertia = f'<inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"/>'
    return f"""<link name="{name}"><inertial><origin xyz="{com}"/>
      <mass value="{mass}"/>{inertia}</inertial>
      <collision><geometry><sphere radius="0.1"/></geometry></collision></link>
      <joint name="free_{name}" type="floating"><parent link="world"/>
      <child link="{name}"/></joint>"""


def system_of(
    folder: Path,
    masses: dict[str, float],
    inside: tuple[str, str] = UNEVEN,
    dtype: str = "float64",
    **changes: Any,
) -> System:
    links = "".join(loose(name, mass, inside) for name, mass in masses.items())
    text = f'<robot name="r"><link name="world"/>{links}</robot>'
    pair = ((Contact("a"), Contact("b")),)
    robot = row(write(folder, text), "a", pairs=pair, **changes)
    return physics.load_system(robot, dtype)


def placed(system: System, *places: tuple[float, float, float]) -> np.ndarray:
    q = system.rest_q.copy().reshape(-1, 7)
    q[:, :3] = places
    return q.reshape(-1)


def momentum(system: System, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Linear momentum (3,) of all bodies, from the velocities of their centres."""
    turn = [reference.rotation_matrix(x[3:]) for x in q.reshape(-1, 7)]
    levers = np.array([r @ com for r, com in zip(turn, system.com, strict=True)])
    linear, angular = v.reshape(-1, 2, 3).swapaxes(0, 1)
    return system.mass @ (linear + np.cross(angular, levers))


@pytest.mark.parametrize(("inside", "order"), [(EVEN, 0.0), (UNEVEN, 0.01)])
def test_a_third_body_changes_no_impact(
    x64: None, tmp_path: Path, inside: tuple[str, str], order: float
) -> None:
    """Momentum is conserved, and who is far away stays where it is.

    Uneven bodies turn after the impact, with centres of mass beside their origins. This
    changes their momentum by the order of h in a substep; the impulses are exact.
    """
    masses = {"a": 1.0, "b": 2.0, "c": 5.0}
    system = system_of(tmp_path, masses, inside, gravity=0.0, dt=1e-3, substeps=1)
    q = placed(system, (0, 0, 1), (-0.18, 0.03, 1.03), (3, 3, 3))
    v = np.zeros(18)
    v[0], v[6] = 3.0, 10.0
    step = jax.jit(lambda q, v: physics.step(system, state_of(q, v), jnp.zeros(0))[0])

    def state_of(q: jax.Array, v: jax.Array) -> physics.PhysicsState:
        return physics.initial_state(system, q, v)

    after = step(q, v)
    assert np.abs(after.impulse[0, :3]).max() > 0.1
    # nothing turns before the impact, so the levers are those of the begin
    before, now = (
        momentum(system, np.asarray(x), np.asarray(y))
        for x, y in ((q, v), (q, after.v))
    )
    lost = before - now
    assert np.abs(lost).max() < (1e-12 + order * system.h) * np.abs(before).max()
    both = after.impulse[0, :3] + after.impulse[1, :3]
    assert np.abs(both).max() < 1e-12 * np.abs(before).max()
    np.testing.assert_array_equal(after.v[12:], 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("near", [2.0, 0.19])
def test_gradients_are_those_of_differences(
    x64: None, tmp_path: Path, near: float
) -> None:
    """On the ground, apart from each other and in touch."""
    contacts = (Contact("a"), Contact("b"))
    system = system_of(tmp_path, {"a": 1.0, "b": 3.0}, contacts=contacts, dt=0.01)
    q = placed(system, (0, 0, 0.095), (near, 0, 0.095))
    rng = np.random.default_rng(0)
    v, weights, ways = (
        rng.normal(size=12),
        rng.normal(size=12),
        rng.normal(size=(4, 12)),
    )

    @jax.jit
    def value(v: jax.Array) -> jax.Array:
        state = physics.initial_state(system, jnp.asarray(q), v)
        return physics.step(system, state, jnp.zeros(0))[0].v @ weights

    slope, h = jax.jit(jax.grad(value))(v), 1e-6
    for way in ways:
        central = (value(v + h * way) - value(v - h * way)) / (2 * h)
        assert slope @ way == pytest.approx(float(central), rel=1e-6, abs=1e-6)


def test_a_plan_of_no_actuators(x64: None, tmp_path: Path) -> None:
    """It has no numbers that could tell its length."""
    system = system_of(tmp_path, {"a": 1.0, "b": 1.0})
    state = physics.initial_state(system, jnp.asarray(system.rest_q), jnp.zeros(12))
    plan = jnp.zeros((3, 0))
    found = jax.jit(lambda s: physics.rollout(system, s, plan))(state)
    step = jax.jit(lambda s, u: physics.step(system, s, u))
    for k in range(3):
        state, fault = step(state, plan[k])
        np.testing.assert_array_equal(found.after.q[k], state.q)
        assert found.fault[k] == fault == 0


def test_a_ball_beside_the_robot_keeps_its_place(x64: None, tmp_path: Path) -> None:
    """The torso alone is put on the ground, wherever other bodies are."""
    contacts = (Contact("a"), Contact("b"))
    specs: tuple[dict[str, Any], ...] = ({}, {"rest_rotation": (0.0, 0.0, 0.5)})
    for spec in specs:
        system = system_of(tmp_path, {"a": 1.0, "b": 1.0}, contacts=contacts, **spec)
        a, b = system.rest_q.reshape(-1, 7)
        assert a[2] == pytest.approx(0.1) and b.tolist() == [0, 0, 0, 0, 0, 0, 1]
        assert (a[5] == 0) == (not spec)
        q = placed(system, (0, 0, 3), (0, 0, -5))
        moved = jax.jit(lambda q, system=system: physics.on_ground(system, q))(q)
        moved = np.asarray(moved)
        assert moved[2] == pytest.approx(0.1)
        np.testing.assert_array_equal(np.delete(moved, 2), np.delete(q, 2))
    only_b = system_of(tmp_path, {"a": 1.0, "b": 1.0}, contacts=contacts[1:])
    assert physics.grounding_coordinate(only_b) is None and only_b.rest_q[2] == 0


def test_locomotion_is_that_of_the_torso(x64: None, tmp_path: Path) -> None:
    """Wherever the file has the ball."""
    leg = link("leg", mass=0.5) + joint(
        "hip",
        "revolute",
        "a",
        "leg",
        '<axis xyz="0 1 0"/><limit lower="-1" upper="1"/>',
    )
    parts = {"a": loose("a", 1.0) + leg, "b": loose("b", 2.0)}
    seen = {}
    for order in ("ab", "ba"):
        text = "".join(parts[name] for name in order)
        path = tmp_path / order
        path.mkdir()
        text = f'<robot name="r"><link name="world"/>{text}</robot>'
        spec = row(write(path, text), "a", actuators=(("hip", 1.0),), gravity=0.0)
        env = Locomotion(spec, dtype="float64", reset_noise_scale=0.0)
        assert env.system.body_names[0] == order[0]
        state = jax.jit(env.fixed_state)()
        bodies = list(env.system.body_names)
        start = int(env.system.v_start[bodies.index("a")])
        v = state.pipeline_state.v.at[start : start + 3].set(jnp.array([2.0, 0, 0.5]))
        moving = dataclasses.replace(state.pipeline_state, v=v)
        after = jax.jit(env.step)(state.replace(pipeline_state=moving), jnp.zeros(1))
        seen[order] = after
        assert after.metrics["x_velocity"] == pytest.approx(2.0, rel=0.1)
        assert after.obs[0] == pytest.approx(0.5 * env.dt, rel=0.2)
    one, two = seen["ab"], seen["ba"]
    np.testing.assert_allclose(one.reward, two.reward, rtol=1e-9)
    np.testing.assert_allclose(one.obs[:5], two.obs[:5], atol=1e-9)
    assert one.obs.shape == two.obs.shape


def test_a_ball_does_not_hide_a_soft_wall(tmp_path: Path) -> None:
    wall = (
        '<robot name="w"><link name="world"/><link name="wall"><collision><origin '
        'xyz="3 0 .5"/><geometry><box size=".01 4 1"/></geometry></collision></link>'
        '<joint name="j" type="fixed"><parent link="world"/><child link="wall"/>'
        "</joint></robot>"
    )
    (tmp_path / "wall.urdf").write_text(wall, encoding="utf-8")
    large = loose("b", 1.0).replace('radius="0.1"', 'radius="3"')
    text = f'<robot name="r"><link name="world"/>{loose("a", 1.0)}{large}</robot>'
    contacts = (Contact("a"), Contact("b"))
    robot = row(write(tmp_path, text), "a", contacts=contacts)
    with pytest.warns(SoftWallWarning, match=r"test, the body on 'a', is held up to"):
        load_system(robot, "float32", Scene("w", str(tmp_path / "wall.urdf")))
    (tmp_path / "wall.urdf").write_text(
        wall.replace("collision>", "visual>"), encoding="utf-8"
    )
    with pytest.warns(RobotDescriptionWarning, match="no link has a collider, so"):
        load_system(robot, "float32", Scene("w", str(tmp_path / "wall.urdf")))


def test_bodies_twenty_metres_apart_are_accurate(tmp_path: Path) -> None:
    """The page on physics names this distance for single precision."""
    contacts = (Contact("a"), Contact("b"))
    system = system_of(
        tmp_path,
        {"a": 4.0, "b": 4.0},
        EVEN,
        contacts=contacts,
        dt=0.01,
        dtype="float32",
    )
    q = jnp.asarray(placed(system, (0, 0, 0.1), (20, 0, 0.1)), jnp.float32)
    rolling = jnp.zeros(12, jnp.float32).at[6].set(1.0).at[10].set(10.0)
    controls = jnp.zeros((100, 0), jnp.float32)
    state = physics.initial_state(system, q, rolling)
    found = jax.jit(lambda: physics.rollout(system, state, controls))()
    assert not found.fault.any()
    np.testing.assert_allclose(found.after.q[-1, 7:10], [21, 0, 0.1], atol=0.01)
