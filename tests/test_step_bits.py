"""The step reproduces every bit, in single precision, and holds no memory."""

from __future__ import annotations

import functools
import hashlib
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from physics_helpers import Arrays, one_step, outputs, report, single_states

from newton_qd import physics
from newton_qd.physics.launch import LANES
from newton_qd.physics.model import build_system
from newton_qd.physics.system import System
from newton_qd.robots import ANT

TESTS = Path(__file__).parent


def assert_bitwise(ours: Arrays, theirs: Arrays) -> None:
    for a, b in zip(ours, theirs, strict=True):
        assert a.dtype == b.dtype
        assert a.tobytes() == b.tobytes()


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
from test_step_bits import digest
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


def gradients(system: System, states: Arrays) -> Arrays:
    return tuple(np.asarray(x) for x in gradient(system)(*states))


@functools.cache
def double_gradients(device: jax.Device) -> Arrays:
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
