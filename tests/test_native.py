"""Kernels of a CPU that XLA calls without Python."""

from __future__ import annotations

import concurrent.futures
import ctypes
import dataclasses
import gc
import subprocess
import sys
import threading
import time
import weakref
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import processes
import pytest
import warp as wp

from newton_qd import physics
from newton_qd.physics import bridge, ending, layout, precision
from newton_qd.physics.launch import Launcher
from newton_qd.physics.native import all_plans
from newton_qd.physics.native.plans import _parts, _Plan
from newton_qd.robots import HOPPER

# Work of hours is in flight when the program ends. XLA runs programs with matrix
# products in a thread of its own.
IN_FLIGHT = """
import sys, threading
import jax, jax.numpy as jnp, newton_qd
env = newton_qd.create("hopper")
state = jax.jit(env.reset)(jax.random.key(0))

A, B = jnp.full((11, 64), .01), jnp.full((64, 3), .01)

@jax.jit
def run(state):
    def advance(state, _):
        return env.step(state, jnp.tanh(jnp.tanh(state.obs @ A) @ B)), None
    return jax.lax.scan(advance, state, None, length=1_000_000_000)[0]

def begin():
    run(state)

"""
ENDS = {
    "end of the script": "begin()",
    "sys.exit": "begin()\nsys.exit(3)",
    "an exception": "begin()\nraise ValueError",
    "two threads": """
threads = [threading.Thread(target=begin, daemon=True) for _ in range(2)]
for thread in threads:
    thread.start()
""",
    "an idle thread": """
threading.Thread(target=threading.Event().wait, daemon=True).start()
begin()
""",
}


CALLBACKS = """
from newton_qd.physics import row_calls
row_calls.native = lambda device: False
"""


def run(code: str) -> tuple[int, float]:
    """Exit status of a program, and seconds from its last line to its end."""
    code += "\nprint('end', flush=True)" if "exit" not in code else ""
    with processes.start([sys.executable, "-c", code], seconds=100.0) as process:
        assert process.stdout is not None
        begin = time.perf_counter()
        for _ in process.stdout:
            begin = time.perf_counter()
        status = process.wait()
        return status, time.perf_counter() - begin


@pytest.mark.slow
def test_a_program_ends_with_work_in_flight(device: jax.Device) -> None:
    del device
    assert run(IN_FLIGHT + ENDS["end of the script"])[0] == 0


@pytest.mark.slow
@pytest.mark.parametrize("end", [end for end in ENDS if end != "end of the script"])
def test_every_way_out_with_work_in_flight(end: str) -> None:
    status, _ = run(IN_FLIGHT + ENDS[end])
    assert status == {"sys.exit": 3, "an exception": 1}.get(end, 0)


@pytest.mark.slow
@pytest.mark.parametrize("end", ["two threads", "an idle thread"])
def test_daemon_threads_leave_the_callbacks(end: str) -> None:
    """As on a GPU, where XLA calls Python."""
    status, seconds = run(CALLBACKS + IN_FLIGHT + ENDS[end])
    assert status == 0
    # nobody waits for a thread that is not inside XLA
    assert end == "two threads" or seconds < ending._LEAVING_SECONDS


@pytest.mark.slow
def test_a_program_that_makes_its_first_call_late_is_waited_for() -> None:
    """XLA would wait for the call, and the call for Python."""
    late = """
import contextlib, time
contained = row_calls._errors_contained

@contextlib.contextmanager
def late():
    if row_calls._Callbacks.ended:
        time.sleep(0.5)
    with contained():
        yield

row_calls._errors_contained = late
"""
    assert run(CALLBACKS + late + IN_FLIGHT + ENDS["two threads"])[0] == 0


@pytest.mark.slow
def test_effects_of_a_program_come_before_its_end() -> None:
    code = (
        IN_FLIGHT
        + """
@jax.jit
def told(state):
    def advance(state, _):
        return env.step(state, jnp.tanh(state.obs[:3])), None
    state = jax.lax.scan(advance, state, None, length=2000)[0]
    jax.debug.print("finite {}", jnp.isfinite(state.obs).all())
told(state)
"""
    )
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=100
    )
    assert found.returncode == 0 and "finite True" in found.stdout


def test_a_plan_belongs_to_what_it_computes() -> None:
    device = wp.get_device("cpu")
    system = physics.load_system(HOPPER)
    equal = physics.load_system(HOPPER)
    other = physics.load_system(dataclasses.replace(HOPPER, gravity=9.0))
    names = ("step_forward", "bodies_forward")
    plans = [
        bridge.launcher(own, device).plan(name)
        for own in (system, equal, other)
        for name in names
    ]
    keys = [plan.key for plan in plans]
    assert keys[:2] == keys[2:4] and len(set(keys)) == 4


def test_a_plan_that_nobody_holds_gives_its_memory_back() -> None:
    """As for the solver, which forgets step lengths."""
    system = physics.load_system(HOPPER)
    launcher = Launcher(system, wp.get_device("cpu"))
    plan, known = launcher.plan("step_forward"), len(all_plans())
    rows = layout.rows(system, "step_forward")
    plan.run(1, [wp.zeros(row.size, wp.float32, device="cpu") for row in rows])
    struct, held = plan._struct, weakref.ref(plan)
    assert struct.pool and len(all_plans()) == known
    del plan, launcher
    gc.collect()
    assert held() is None and not struct.pool


def test_a_plan_can_be_registered_again() -> None:
    """As for a system that makes steps and rollouts. No list of plans has a ring."""
    system = physics.load_system(dataclasses.replace(HOPPER, gravity=8.0))
    plan = bridge.launcher(system, wp.get_device("cpu")).plan("step_forward")
    plan.register()
    known = len(all_plans())
    plan.register()
    assert plan in all_plans() and len(all_plans()) == known
    place, seen = ctypes.addressof(plan._struct), []
    while place:
        assert place not in seen
        seen.append(place)
        place = _Plan.from_address(place).next


def test_parts_tell_contents_apart() -> None:
    contents = [
        (1, 2), (1, (2,)), ((1,), 2), (12,), "(1, 2)", (1.0, 2), [],
        np.zeros(2), np.zeros((1, 2)), np.zeros(2, np.float32), np.ones(2),
        {"a": 1}, {"b": 1}, None,
    ]  # fmt: skip
    assert len({"\n".join(_parts(content)) for content in contents}) == len(contents)
    assert _parts(np.arange(6).reshape(2, 3).T) != _parts(np.arange(6).reshape(3, 2))


@pytest.mark.parametrize("threads", ["1", "2", "5", "300"])
def test_threads_change_nothing(
    monkeypatch: pytest.MonkeyPatch, device: jax.Device, threads: str
) -> None:
    if device.platform != "cpu":
        pytest.skip("threads are for CPUs")
    system = physics.load_system(HOPPER)
    step = jax.jit(jax.vmap(bridge.control_step(system)))
    q = jnp.asarray(system.rest_q, jnp.float32) + 0.01 * jax.random.normal(
        jax.random.key(0), (203, system.nq)
    )
    v, control = jnp.zeros((203, system.nv)), jnp.zeros((203, system.nu))
    monkeypatch.setenv("NEWTON_QD_THREADS", "1")
    expected = step(q, v, control)
    monkeypatch.setenv("NEWTON_QD_THREADS", threads)
    for _ in range(3):
        jax.tree.map(np.testing.assert_array_equal, step(q, v, control), expected)


def test_threads_build_a_variant_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of a package would be imported by the next thread."""
    begun, names = threading.Barrier(4), []
    real = precision._run_template

    def slow(name: str) -> ModuleType:
        names.append(name)
        time.sleep(0.05)
        return real(name)

    monkeypatch.setattr(precision, "_run_template", slow)
    variant = precision.Variant("float32", 5, boxes=True)

    def build(_: int) -> precision.Kernels:
        begun.wait(60)
        return precision.build_kernels(variant)

    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        found = list(pool.map(build, range(4)))
    assert len(names) == 2  # with boxes, and what it shares with the plain variant
    assert all(each is found[0] for each in found)
