"""The step as a function: smooth, finite, with errors that name a wrong input."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics_helpers import (
    POINTS,
    Arrays,
    growth,
    outputs,
    random_states,
    report,
    rollout,
    single_states,
)
from urdf_text import joint, link, row, write

import newton_qd
from newton_qd import physics
from newton_qd.physics import reference
from newton_qd.physics.launch import lane_count, thread_count
from newton_qd.physics.model import build_system
from newton_qd.physics.system import System
from newton_qd.robots import ANT, ROBOTS, Material

# Smoothness


def test_growth_tells_smooth_from_kinked() -> None:
    x = np.linspace(-1.0, 1.0, POINTS)
    assert growth(np.maximum(x - 0.0123, 0.0) ** 2) == pytest.approx(2.0, abs=0.1)
    assert growth(np.maximum(x - 0.0123, 0.0)) == pytest.approx(1.0, abs=0.1)
    assert growth(np.where(x > 0.0123, 1.0, 0.0)) == pytest.approx(0.0, abs=0.1)


def landing(system: System, rng: np.random.Generator) -> tuple[Arrays, Arrays]:
    """A line that starts in the air and ends with feet in the ground."""
    q, v, control = (x[-1] for x in random_states(system, rng, 2))
    q[2] += 0.1 - reference.lowest_contact(system, q)
    ahead = np.concatenate([np.zeros(7), 0.02 * rng.normal(size=8)])
    ahead[2] = -0.13
    return (q, 0.2 * v, control), (ahead, 0.2 * v, np.zeros(system.nu))


def bending(system: System, rng: np.random.Generator) -> tuple[Arrays, Arrays]:
    """A line on which a hip passes its limit, in the air."""
    q, v, control = (x[-1] for x in random_states(system, rng, 2))
    q[2] += 5.0
    q[7:] = system.rest_q[7:]
    q[7] = system.limit_upper[6]
    ahead = np.zeros(system.nq)
    ahead[7] = 0.3
    ahead[8:] = 0.02 * rng.normal(size=7)
    return (q, v, control), (ahead, rng.normal(size=system.nv), np.zeros(system.nu))


@pytest.mark.parametrize("line", [landing, bending])
def test_step_is_smooth_through_events(x64: None, line: Callable[..., Any]) -> None:
    """Second differences shrink with the square of the distance."""
    system = physics.load_system(ANT, "float64")
    rng = np.random.default_rng(0)
    orders = []
    for _ in range(4):
        start, direction = line(system, rng)
        s = np.linspace(-1.0, 1.0, POINTS)[:, None]
        states = tuple(x + s * d for x, d in zip(start, direction, strict=True))
        q, v, impulse, normal, fault = outputs(system, states)
        assert not fault.any()
        if line is landing:
            assert normal[0].sum() == 0 and normal[-1].sum() > 0
            orders += [growth(impulse), growth(normal)]
        else:
            past = states[0][:, 7] - system.limit_upper[6]
            assert past[0] < -0.2 and past[-1] > 0.2
            assert not normal.any()
        orders += [growth(q), growth(v)]
    report("orders", np.round(orders, 3))
    assert min(orders) > 1.9


# Joint limits


def hinge_system(folder: Path, **material: Any) -> System:
    """A driven hinge between -0.5 and 0.5 rad; no gravity."""
    inside = """<axis xyz="0 1 0"/><dynamics damping="3.0"/>
      <limit lower="-0.5" upper="0.5" effort="50" velocity="20"/>"""
    hinge = joint("hinge", "revolute", "world", "arm", inside)
    text = f'<robot name="hinge"><link name="world"/>{link("arm")}{hinge}</robot>'
    robot = row(
        write(folder, text),
        "arm",
        actuators=(("hinge", 20.0),),
        gravity=0.0,
        dt=0.05,
        substeps=5,
        material=Material(**material),
    )
    return build_system(robot, "float64")


@pytest.mark.parametrize("overshoot", [0.05, 0.1])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_full_gear_overshoots_a_limit_as_stated(
    x64: None, tmp_path: Path, side: float, overshoot: float
) -> None:
    system = hinge_system(tmp_path, limit_overshoot=overshoot)
    path = rollout(system)(
        jnp.zeros(1), jnp.zeros(1), jnp.full((200, 1), side, np.float64)
    )
    angle = side * np.asarray(path.q[:, 0])
    report("rest, peak beyond the limit [rad]", (angle[-1] - 0.5, angle.max() - 0.5))
    assert angle[-1] == pytest.approx(0.5 + overshoot, abs=1e-6)


# Finite


TASKS = [
    f"{name}_uni" if f"{name}_uni" in newton_qd.tables.descriptor_extractor else name
    for name in ROBOTS
]


@pytest.mark.slow
@pytest.mark.parametrize("name", [*TASKS, "anttrap", "antmaze", "humanoidtrap"])
def test_ten_thousand_steps_are_finite(name: str) -> None:
    """64 worlds, uniformly random actions; nothing starts again."""
    env = newton_qd.create(name, episode_length=20_000, auto_reset=False)
    worlds, steps, chunk = 64, 10_000, 1_000

    @jax.jit
    def play(state: Any, key: jax.Array) -> Any:
        def advance(carry: Any, action: jax.Array) -> Any:
            state, finite = carry
            state = jax.vmap(env.step)(state, action)
            for leaf in (state.obs, state.reward, state.pipeline_state.v):
                finite &= jnp.isfinite(leaf).all()
            finite &= (state.info["fault"] == 0).all()
            return (state, finite), None

        shape = (chunk, worlds, env.action_size)
        actions = jax.random.uniform(key, shape, np.float32, -1.0, 1.0)
        state, finite = jax.lax.scan(advance, (state, jnp.array(True)), actions)[0]
        for leaf in jax.tree.leaves(state):
            finite &= jnp.isfinite(leaf).all()
        return state, finite

    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), worlds))
    for key in jax.random.split(jax.random.key(1), steps // chunk):
        state, finite = play(state, key)
        assert finite
    assert (state.info["steps"] == steps).all()
    newton_qd.check(state)
    fastest = jnp.abs(state.pipeline_state.v).max()
    report("largest velocity at the end", float(fastest))


# Input


@pytest.mark.parametrize("text", ["0", "-1", "two", "", "1.5"])
def test_bad_number_of_threads(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv("NEWTON_QD_THREADS", text)
    with pytest.raises(ValueError, match="NEWTON_QD_THREADS"):
        thread_count()


def test_bad_number_of_threads_stops_a_step(
    device: jax.Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    if device.platform != "cpu":
        pytest.skip("threads are the CPU's")
    system, states = single_states(4)
    monkeypatch.setenv("NEWTON_QD_THREADS", "many")
    # a callback's error arrives as JAX's own, which names it
    with pytest.raises((ValueError, RuntimeError), match="THREADS: got 'many'"):
        outputs(system, states)
    # where a step is traced, before anything is compiled
    with pytest.raises(ValueError, match="THREADS: got 'many'"):
        jax.eval_shape(functools.partial(physics.step, system), *one_state(system))
    monkeypatch.delenv("NEWTON_QD_THREADS")
    assert np.isfinite(outputs(system, states)[0]).all()


def one_state(system: System) -> tuple[physics.PhysicsState, jax.Array]:
    """The default pose at rest, and a zero control."""
    q, v = jnp.asarray(system.rest_q, system.dtype), jnp.zeros(system.nv, system.dtype)
    state = physics.initial_state(system, q, v)
    return state, jnp.zeros(system.nu, system.dtype)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        (
            {"q": np.zeros(14, np.float32)},
            ValueError,
            r"q: got .*shape \(14,\).*\(15,\)",
        ),
        (
            {"v": np.zeros(15, np.float32)},
            ValueError,
            r"v: got .*shape \(15,\).*\(14,\)",
        ),
        ({"q": np.zeros((2, 15), np.float32)}, ValueError, r"q: got .*shape \(2, 15\)"),
        ({"v": np.zeros(14, np.int32)}, TypeError, "v: got .*int32; .*float32"),
        ({"q": np.zeros(15, np.float16)}, TypeError, "q: got .*float16; .*float32"),
    ],
)
def test_a_state_of_another_robot_is_named(
    changes: dict[str, np.ndarray], error: type[Exception], message: str
) -> None:
    system, _ = single_states(1)
    state, control = one_state(system)
    arrays = {name: jnp.asarray(value) for name, value in changes.items()}
    wrong = dataclasses.replace(state, **arrays)
    with pytest.raises(error, match=message):
        physics.step(system, wrong, control)


@pytest.mark.parametrize("speed", [900.0, 1100.0])
def test_a_diverging_world_is_at_fault(speed: float) -> None:
    system, _ = single_states(1)
    state, control = one_state(system)
    flying = dataclasses.replace(state, v=state.v.at[0].set(speed))
    after, fault = jax.jit(functools.partial(physics.step, system))(flying, control)
    assert int(fault) == (speed > 1000)
    if fault:
        np.testing.assert_array_equal(after.q, flying.q)


@pytest.mark.parametrize("text", ["0", "3", "64", "x", ""])
def test_bad_number_of_lanes(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv("NEWTON_QD_LANES", text)
    with pytest.raises(ValueError, match="NEWTON_QD_LANES"):
        lane_count("step_backward")


def test_bad_deterministic_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NEWTON_QD_DETERMINISTIC", "yes")
    with pytest.raises(ValueError, match="NEWTON_QD_DETERMINISTIC"):
        lane_count("step_backward")
