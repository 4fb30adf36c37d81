"""``state.qp`` and ``env.sys``, against plain NumPy and against the observation."""

from __future__ import annotations

import copy
import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contract import row

import newton_qd
from newton_qd import wrappers
from newton_qd.brax_views import (
    BODY_NAMES,
    QP,
    BraxState,
    BraxViewsWrapper,
    FixedInitialStateWrapper,
    Info,
)
from newton_qd.brax_views.views import SystemView
from newton_qd.compat import brax_envs, env_creators
from newton_qd.envs.ant import Ant
from newton_qd.envs.joints import solid_bodies
from newton_qd.envs.pointmaze import PointMaze
from newton_qd.envs.state import State
from newton_qd.physics import load_system, reference
from newton_qd.robots import ANT as ANT_SPEC
from newton_qd.robots import ROBOTS, Material
from newton_qd.wrappers import TrapWrapper

ANT: Any = BraxViewsWrapper(Ant())
KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def batch() -> BraxState:
    """Three ants after some steps."""
    state = jax.jit(jax.vmap(ANT.reset))(jax.random.split(KEY, 3))
    step = jax.jit(jax.vmap(ANT.step))
    for index in range(6):
        key = jax.random.key(index)
        action = jax.random.uniform(key, (3, 8), np.float32, -1.0, 1.0)
        state = step(state, action)
    return state


def test_bodies_are_where_the_kinematics_puts_them(batch: BraxState) -> None:
    system, qp = ANT.system, batch.qp
    assert qp.pos.shape == qp.vel.shape == qp.ang.shape == (3, 10, 3)
    assert qp.rot.shape == (3, 10, 4)
    for world in range(3):
        q = np.asarray(batch.pipeline_state.q[world], np.float64)
        v = np.asarray(batch.pipeline_state.v[world], np.float64)
        frames = reference.body_frames(system, q)
        linear, angular = reference.jacobians(system, q)
        centre = [
            reference.compose(frame, np.append(com, [0, 0, 0, 1]))[:3]
            for frame, com in zip(frames, system.com, strict=True)
        ]
        np.testing.assert_allclose(qp.pos[world, :9], centre, atol=1e-5)
        np.testing.assert_allclose(qp.vel[world, :9], linear @ v, atol=1e-4)
        np.testing.assert_allclose(qp.ang[world, :9], angular @ v, atol=1e-4)
        wxyz = frames[:, [6, 3, 4, 5]]
        same = np.abs(np.sum(wxyz * np.asarray(qp.rot[world, :9]), axis=1))
        np.testing.assert_allclose(same, 1.0, atol=1e-5)


def test_the_ground_is_the_last_row(batch: BraxState) -> None:
    qp = batch.qp
    for part in (qp.pos, qp.vel, qp.ang):
        assert np.all(part[:, 9] == 0)
    assert np.all(qp.rot[:, 9] == np.array([1, 0, 0, 0]))


def test_a_batch_is_its_worlds(batch: BraxState) -> None:
    alone = jax.jit(lambda state: state.qp)(row(batch, 1))
    rows = jax.tree.map(lambda x: np.asarray(x)[None], batch)
    nested = jax.jit(lambda state: state.qp)(rows)
    for part in ("pos", "rot", "vel", "ang"):
        whole = getattr(batch.qp, part)
        np.testing.assert_allclose(getattr(alone, part), whole[1], atol=1e-6)
        assert np.array_equal(getattr(nested, part)[0], whole)


def test_rows_by_both_names() -> None:
    index = ANT.sys.body.index
    assert index["$ Torso"] == index["torso"] == 0
    feet = [index[name] for name in ("$ Body 4", "$ Body 7", "$ Body 10", "$ Body 13")]
    assert (
        feet
        == [index[foot] for foot in newton_qd.tables.FEET_NAMES["ant"]]
        == [2, 4, 6, 8]
    )
    assert [index[f"Aux {leg}"] for leg in (1, 2, 3, 4)] == [1, 3, 5, 7]
    assert index["Ground"] == index["floor"] == 9
    with pytest.raises(TypeError):
        index["mine"] = 3  # pyright: ignore[reportIndexIssue]


def test_joints_are_those_of_the_observation(batch: BraxState) -> None:
    (joints,) = ANT.sys.joints
    (angles,), (rates,) = joints.angle_vel(batch.qp)
    assert np.array_equal(angles, batch.obs[:, 5:13])
    assert np.array_equal(rates, batch.obs[:, 19:27])
    assert ANT.sys.num_joint_dof == 8


def test_joints_are_flat_arrays_too(batch: BraxState) -> None:
    """Newer releases of brax v1 return them so: joint by joint, all its axes."""
    (joints,) = ANT.sys.joints
    angles, rates = joints.angle_vel(batch.qp)
    for found, expected in ((angles, batch.obs[:, 5:13]), (rates, batch.obs[:, 19:27])):
        assert np.array_equal(jnp.asarray(found), expected)
        assert np.array_equal(np.asarray(found), expected)
    again = jax.jit(lambda x: x)(angles)
    assert jax.tree.structure(again) == jax.tree.structure(angles)
    humanoid: Any = newton_qd.create("humanoid", brax_views=True)
    qp = humanoid.sys.default_qp()

    @jax.jit
    def all_angles(qp: Any) -> jax.Array:
        joints = humanoid.sys.joints
        return jnp.concatenate([joint.angle_vel(qp)[0] for joint in joints])

    flat = all_angles(qp)
    settings = humanoid.sys.config.joints
    counts = [len(joint.angle_limit) for joint in settings]
    assert counts == sorted(counts) and sum(counts) == humanoid.sys.num_joint_dof
    named = {x.name: x.angle for x in humanoid.sys.config.defaults[0].angles}
    axes = [(j, "xyz"[i]) for j in settings for i in range(len(j.angle_limit))]
    degrees = [getattr(named[joint.name], axis) for joint, axis in axes]
    assert np.array_equal(flat, np.radians(degrees).astype(np.float32))
    assert humanoid.sys.config.dynamics_mode == "legacy_spring"
    assert all(joint.stiffness > 0 for joint in settings)


def test_joints_of_the_fixed_initial_state() -> None:
    # the test of QDax: exactly the default angles, exactly at rest
    env: Any = newton_qd.create("ant_uni", fixed_init_state=True, brax_views=True)
    state = env.reset(jax.random.PRNGKey(10))
    angle_vel = [joint.angle_vel(state.qp) for joint in env.sys.joints]
    angles = jnp.concatenate([a for angle, _ in angle_vel for a in angle])
    rates = jnp.concatenate([v for _, vel in angle_vel for v in vel])
    assert np.array_equal(angles, env.sys.default_angle())
    assert np.array_equal(rates, jnp.zeros(env.sys.num_joint_dof))


def test_default_pose() -> None:
    sys = ANT.sys
    default, fixed = sys.default_qp(), ANT.fixed_state().qp
    for part in ("pos", "rot", "vel", "ang"):
        assert np.array_equal(getattr(default, part), getattr(fixed, part))
    same = sys.default_qp(joint_angle=sys.default_angle())
    np.testing.assert_allclose(same.pos, default.pos, atol=1e-6)
    # a reset is the default pose with other joints
    reset = ANT.reset(KEY)
    physics_state = reset.pipeline_state
    found = sys.default_qp(physics_state.q[7:], physics_state.v[6:])
    for part in ("pos", "rot", "vel", "ang"):
        expected = getattr(reset.qp, part)
        np.testing.assert_allclose(getattr(found, part), expected, atol=1e-6)
    with pytest.raises(ValueError, match=r"joint_angle: got shape \(3,\);.*\(8,\)"):
        sys.default_qp(jnp.zeros(3))


def test_contact_is_that_of_the_observation(batch: BraxState) -> None:
    contact = jax.jit(lambda state: ANT.sys.info(state.qp).contact)(batch)
    assert np.any(contact.vel != 0)
    for values, first in ((contact.vel, 27), (contact.ang, 57)):
        seen = np.clip(np.asarray(values), -1, 1).reshape(3, 30)
        np.testing.assert_allclose(seen, batch.obs[:, first : first + 30], atol=1e-4)
    still = jax.jit(lambda: ANT.sys.info(ANT.fixed_state().qp).contact)()
    assert np.all(still.vel == 0) and np.all(still.ang == 0)


def test_contact_changes_velocities_by_mass_and_inertia() -> None:
    system = load_system(ROBOTS["quadruped"])  # others have the original's inertia of 1
    rng, solid = np.random.default_rng(0), solid_bodies(system)
    rot = rng.normal(size=(len(solid) + 1, 4))
    rot /= np.linalg.norm(rot, axis=1, keepdims=True)
    impulse = rng.normal(size=(system.nb, 6))
    physics: Any = SimpleNamespace(impulse=jnp.asarray(impulse, np.float32))
    none = jnp.zeros((len(rot), 3), np.float32)
    qp = QP(none, jnp.asarray(rot, np.float32), none, none, physics)
    found = SystemView(system).info(qp).contact
    for place, body in enumerate(solid):
        turn = reference.rotation_matrix(np.roll(rot[place], -1))
        inertia = turn @ system.inertia[body] @ turn.T
        speeds = impulse[body, :3] / system.mass[body]
        rates = np.linalg.solve(inertia, impulse[body, 3:])
        np.testing.assert_allclose(found.vel[place], speeds, rtol=1e-4)
        np.testing.assert_allclose(found.ang[place], rates, rtol=1e-3, atol=0.01)
    assert not found.vel[-1].any() and not found.ang[-1].any()  # the ground


def test_limits_of_joints_are_ordered() -> None:
    joints = {joint.name: joint for joint in ANT.sys.config.joints}
    (hip,), (ankle,) = joints["hip_1"].angle_limit, joints["ankle_1"].angle_limit
    assert (hip.min, hip.max) == pytest.approx((-30, 30))
    assert (ankle.min, ankle.max) == pytest.approx((30, 70))
    turning: Any = newton_qd.create("acrobot", brax_views=True)
    (free,) = turning.sys.config.joints[0].angle_limit
    assert (free.min, free.max) == (-360, 360)


@pytest.mark.parametrize("repeat", [1, 3])
def test_config(repeat: int) -> None:
    env: Any = newton_qd.create("ant_uni", action_repeat=repeat, brax_views=True)
    assert env.sys.config.dt == env.dt == 0.05 * repeat
    assert env.sys.config.substeps == 5 * repeat


def test_a_state_without_bodies() -> None:
    state = PointMaze().reset(KEY)
    assert not hasattr(state, "qp")
    with pytest.raises(AttributeError, match="without bodies"):
        getattr(state, "qp")  # noqa: B009
    assert not hasattr(newton_qd.create("pointmaze"), "sys")
    viewed: Any = newton_qd.create("pointmaze", brax_views=True)
    assert not hasattr(viewed.reset(KEY), "qp") and not hasattr(viewed, "sys")


def test_states_of_one_robot_have_one_structure(batch: BraxState) -> None:
    other = newton_qd.create(
        "ant", episode_length=None, auto_reset=False, brax_views=True
    )
    same = jax.tree.structure(other.reset(KEY)) == jax.tree.structure(batch)
    assert same
    assert copy.copy(batch).system is ANT.system
    assert "system" not in repr(batch)


def test_observation_function_of_the_fixed_initial_state() -> None:
    seen = []

    def observe(qp: QP, info: Info, action: jax.Array) -> jax.Array:
        seen.append((qp.pos.shape, info.contact.vel.shape, action.tolist()))
        return jnp.full(87, qp.pos[0, 2])

    height = float(ANT.fixed_state().obs[0])
    env = FixedInitialStateWrapper(newton_qd.create("ant"), "ant", observe)
    state = env.reset(KEY)
    np.testing.assert_allclose(state.obs, [height] * 87, rtol=1e-6)
    assert np.array_equal(state.obs, state.info["first_obs"])
    assert seen == [((10, 3), (10, 3), [0.0] * 8)]
    after = jax.jit(env.step)(state, jnp.zeros(8, np.float32))
    assert after.obs.shape == (87,) and np.ptp(after.obs) > 0

    short = FixedInitialStateWrapper(Ant(), "ant", lambda qp, info, action: qp.pos[0])
    text: Any = "obs"
    with pytest.raises(
        TypeError, match=r"get_obs_fn: got 'obs'; allowed: None, or a f"
    ):
        FixedInitialStateWrapper(Ant(), get_obs_fn=text)
    with pytest.raises(ValueError, match=r"get_obs_fn: .*\(3,\).*; allowed: .*\(87,\)"):
        short.reset(KEY)
    with pytest.raises(NotImplementedError, match=r"^This wrapper does not support"):
        FixedInitialStateWrapper(PointMaze(), "pointmaze", observe)


def test_states_of_two_materials_can_be_mapped_over() -> None:
    soft = Ant().with_material(Material(static_penetration=0.01))
    states = Ant().reset(KEY), soft.reset(KEY)
    found = jax.tree.map(jnp.subtract, *states)
    assert type(found) is State and float(found.reward) == 0
    # with views each state knows its robot: they cannot, and the error is short
    viewed = ANT.reset(KEY), BraxViewsWrapper(soft).reset(KEY)
    with pytest.raises(ValueError, match=r"<ant at 0x\w+>") as caught:
        jax.tree.map(jnp.subtract, *viewed)
    assert len(str(caught.value)) < 2000


def test_a_step_shows_the_robot_that_made_it() -> None:
    trap: Any = BraxViewsWrapper(TrapWrapper(Ant(), "ant"))
    for start in (ANT.reset(KEY), Ant().reset(KEY)):
        after = trap.step(start, jnp.zeros(8, np.float32))
        assert after.system is trap.system
        assert after.qp.pos.shape == (11, 3)
    assert trap.sys.body.index["Trap"] == 10


def test_plain_environments_say_where_the_views_are() -> None:
    env = newton_qd.create("ant")
    state: Any = env.reset(KEY)
    assert isinstance(state, State) and not isinstance(state, BraxState)
    for thing, name in ((env, "sys"), (env.unwrapped, "sys"), (state, "qp")):
        said = rf"^{name}: .*allowed: .*newton_qd\.create\(\.\.\., brax_views=True\)"
        with pytest.raises(AttributeError, match=said):
            getattr(thing, name)
    with pytest.raises(AttributeError, match="'State' object has no attribute 'pose'"):
        getattr(state, "pose")  # noqa: B009
    with pytest.raises(
        TypeError, match=r"get_obs_fn: got .*newton_qd\.brax_views\.Fixed"
    ):
        wrappers.FixedInitialStateWrapper(Ant(), "ant", len)  # pyright: ignore
    with pytest.raises(TypeError, match=r"brax_views: got 3; allowed: True, False"):
        newton_qd.create("ant", brax_views=3)  # pyright: ignore[reportArgumentType]


def test_names_of_bodies_of_an_own_robot() -> None:
    env = BraxViewsWrapper(Ant(), body_names={"foot_2": "Claw"})
    index = env.sys.body.index
    assert index["Claw"] == index["foot_2"] == 4 and "$ Torso" not in index
    with pytest.raises(TypeError, match=r"original_names: got .*BraxViewsWrapper\(env"):
        dataclasses.replace(ANT_SPEC, original_names=(("foot_2", "Claw"),))


@pytest.mark.parametrize("name", BODY_NAMES)
def test_names_of_bodies_of_a_robot_with_another_name(name: str) -> None:
    own: Any = newton_qd.create(name, brax_views=True)
    damaged = dataclasses.replace(own.robot, name="damaged")
    env: Any = newton_qd.create(name, robot=damaged, brax_views=True)
    assert env.sys.body.index == own.sys.body.index
    assert own.with_robot(damaged).sys.body.index == own.sys.body.index


def test_robots_without_original_names_have_none() -> None:
    env: Any = newton_qd.create("reacher", brax_views=True)
    assert "target" in env.sys.body.index and "Target" not in env.sys.body.index


def places(env: Any) -> Any:
    """Jitted function of a key: positions of the bodies after a reset."""
    return jax.jit(lambda key: env.reset(key).qp.pos)


def test_compat_shows_the_views() -> None:
    for creators in (brax_envs, env_creators):
        env: Any = creators.create("ant_uni", episode_length=5)
        assert places(env)(KEY).shape == (10, 3)
        assert env.sys.config.substeps == 5
        env = creators.create_fn("ant", batch_size=2)()
        assert places(env)(KEY).shape == (2, 10, 3)
        assert not hasattr(creators.create("ant", brax_views=False), "sys")
