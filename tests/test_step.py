"""The step as a function: smooth, finite, reproducible to the bit, without leaks."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics_helpers import (
    POINTS,
    batched_step,
    growth,
    one_step,
    random_states,
    report,
    rollout,
)
from urdf_text import joint, link, row, write

import newton_qd
from newton_qd import physics
from newton_qd.physics import reference
from newton_qd.physics.launch import LANES, lane_count, thread_count
from newton_qd.physics.model import build_system
from newton_qd.physics.system import System
from newton_qd.robots import ANT, ROBOTS, Material

TESTS = Path(__file__).parent

States = tuple[np.ndarray, ...]


def single_states(worlds: int, seed: int = 0) -> tuple[System, States]:
    """The ant in float32 with random states."""
    system = physics.load_system(ANT)
    states = random_states(system, np.random.default_rng(seed), worlds)
    return system, tuple(x.astype(np.float32) for x in states)


def outputs(system: System, states: States) -> States:
    return tuple(np.asarray(x) for x in batched_step(system)(*states))


def assert_bitwise(ours: States, theirs: States) -> None:
    for a, b in zip(ours, theirs, strict=True):
        assert a.dtype == b.dtype
        assert a.tobytes() == b.tobytes()


# Smoothness


def test_growth_tells_smooth_from_kinked() -> None:
    x = np.linspace(-1.0, 1.0, POINTS)
    assert growth(np.maximum(x - 0.0123, 0.0) ** 2) == pytest.approx(2.0, abs=0.1)
    assert growth(np.maximum(x - 0.0123, 0.0)) == pytest.approx(1.0, abs=0.1)
    assert growth(np.where(x > 0.0123, 1.0, 0.0)) == pytest.approx(0.0, abs=0.1)


def landing(system: System, rng: np.random.Generator) -> tuple[States, States]:
    """A line that starts in the air and ends with feet in the ground."""
    q, v, control = (x[-1] for x in random_states(system, rng, 2))
    q[2] += 0.1 - reference.lowest_contact(system, q)
    ahead = np.concatenate([np.zeros(7), 0.02 * rng.normal(size=8)])
    ahead[2] = -0.13
    return (q, 0.2 * v, control), (ahead, 0.2 * v, np.zeros(system.nu))


def bending(system: System, rng: np.random.Generator) -> tuple[States, States]:
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


# Bitwise


@pytest.mark.optimized
def test_row_of_a_batch_is_the_world_alone() -> None:
    system, states = single_states(64)
    batch = outputs(system, states)
    step = jax.jit(one_step(system))
    for world in (0, 17, 63):
        alone = tuple(np.asarray(x) for x in step(*(x[world] for x in states)))
        assert_bitwise(alone, tuple(x[world] for x in batch))
        one = outputs(system, tuple(x[world : world + 1] for x in states))
        assert_bitwise(one, tuple(x[world : world + 1] for x in batch))


@pytest.mark.optimized
def test_runs_are_equal() -> None:
    """Again, and in scratch memory that other worlds have used or nobody yet."""
    system, states = single_states(64)
    first = outputs(system, states)
    outputs(*single_states(64, seed=1))
    assert_bitwise(outputs(system, states), first)
    assert_bitwise(outputs(build_system(ANT, "float32"), states), first)


@pytest.mark.optimized
@pytest.mark.slow
def test_another_process_is_equal(device: jax.Device) -> None:
    script = f"""
import jax
from test_step import digest
with jax.default_device(jax.devices({device.platform!r})[0]):
    print(digest())
"""
    paths = [str(TESTS), str(TESTS.parent), os.environ.get("PYTHONPATH", "")]
    # on a GPU this process may hold most of the memory already
    changes = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    result = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, **changes, "PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )
    assert result.stdout.split()[-1] == digest()


def digest() -> str:
    """Fingerprint of the outputs of a batch."""
    system, states = single_states(64)
    data = b"".join(x.tobytes() for x in outputs(system, states))
    return hashlib.sha256(data).hexdigest()


@pytest.mark.optimized
def test_threads_change_nothing(
    device: jax.Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NEWTON_QD_THREADS", raising=False)
    system, states = single_states(64)
    expected, expected_bars = outputs(system, states), gradients(system, states)
    for threads in ("1", "2", "3"):
        monkeypatch.setenv("NEWTON_QD_THREADS", threads)
        assert_bitwise(outputs(system, states), expected)
        # a new system makes its threads anew
        assert_bitwise(outputs(build_system(ANT, "float32"), states), expected)
        if device.platform == "cpu":
            assert_bitwise(gradients(system, states), expected_bars)


@functools.cache
def gradient(system: System) -> Callable[..., Any]:
    def value(q: jax.Array, v: jax.Array, control: jax.Array) -> jax.Array:
        q, v, impulse, normal, _ = one_step(system)(q, v, control)
        return (q**2).sum() + (v**2).sum() + impulse.sum() + (normal**2).sum()

    return jax.jit(jax.vmap(jax.grad(value, argnums=(0, 1, 2))))


def gradients(system: System, states: States) -> States:
    return tuple(np.asarray(x) for x in gradient(system)(*states))


@functools.cache
def double_gradients(device: jax.Device) -> States:
    """Gradients in float64, on a GPU with one lane."""
    states = single_states(64)[1]
    with pytest.MonkeyPatch.context() as patch, jax.enable_x64(True):
        patch.setenv("NEWTON_QD_LANES", "1")
        with jax.default_device(device):
            system = physics.load_system(ANT, "float64")
            return gradients(system, tuple(x.astype(np.float64) for x in states))


def gradient_errors(device: jax.Device) -> np.ndarray:
    """Errors (3, worlds) of float32 gradients against float64."""
    system, states = single_states(64)
    double = double_gradients(device)
    with jax.default_device(device):
        single = gradients(system, states)
    size = [np.linalg.norm(b, axis=1) for b in double]
    pairs = zip(single, double, size, strict=True)
    return np.array([np.linalg.norm(a - b, axis=1) / n for a, b, n in pairs])


def test_single_precision_gradient(device: jax.Device) -> None:
    errors = gradient_errors(device)
    report("largest error for q, v, control", errors.max(axis=1))
    assert errors.max() < 1e-4


@pytest.mark.gpu
@pytest.mark.parametrize("lanes", LANES)
def test_lanes_change_nothing(
    device: jax.Device, monkeypatch: pytest.MonkeyPatch, lanes: int
) -> None:
    system, states = single_states(64)
    monkeypatch.setenv("NEWTON_QD_LANES", "1")
    expected = outputs(system, states)
    monkeypatch.setenv("NEWTON_QD_LANES", str(lanes))
    assert_bitwise(outputs(system, states), expected)
    errors = gradient_errors(device)
    report("largest error for q, v, control", errors.max(axis=1))
    assert errors.max() < 1e-4


@pytest.mark.gpu
@pytest.mark.parametrize("setting", ["NEWTON_QD_LANES", "NEWTON_QD_DETERMINISTIC"])
def test_one_lane_gives_the_same_gradient_twice(
    device: jax.Device, monkeypatch: pytest.MonkeyPatch, setting: str
) -> None:
    """The deterministic mode: a world's only thread adds in the program's order."""
    monkeypatch.setenv(setting, "1")
    system, states = single_states(4096)
    first = gradients(system, states)
    for _ in range(3):
        assert_bitwise(gradients(system, states), first)


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


# Steady state


def resident_bytes() -> int:
    """Memory that this process holds."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs Linux")
def test_nothing_grows() -> None:
    """One compilation, and no memory that is not given back."""
    system, states = single_states(8)
    traces = []

    def step(*inputs: jax.Array) -> Any:
        traces.append("step")
        return jax.vmap(one_step(system))(*inputs)

    def slope(*inputs: jax.Array) -> Any:
        traces.append("slope")
        return gradient(system)(*inputs)

    for function, count in ((jax.jit(step), 2000), (jax.jit(slope), 500)):

        def call(times: int, function: Callable[..., Any] = function) -> None:
            for _ in range(times):
                jax.block_until_ready(function(*states))

        call(count // 5)
        before = resident_bytes()
        call(count)
        grown = resident_bytes() - before
        report(f"growth over {count} calls [kB]", grown / 1e3)
        assert grown < 4e6
    assert traces == ["step", "slope"]
