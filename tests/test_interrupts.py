"""Ctrl-C at any moment of a run: KeyboardInterrupt, and never a wrong result.

The interrupts hit a child process, this file run as a script, so that a crash of its
interpreter is seen and none of them hits pytest.
"""

from __future__ import annotations

import hashlib
import os
import random
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import jax
import jax.numpy as jnp
import numpy as np
import processes
import pytest
from fresh_python import run_python

import newton_qd
from newton_qd import physics
from newton_qd.physics import interrupts, row_calls
from newton_qd.physics.warp_internals import ffi_module
from newton_qd.robots import ANT

INTERRUPTS = 20
ENTRY = 40  # moments in a row from the first one on, in which a callback is entered
MOMENTS = 200
TIMEOUT_S = 100.0
RETRY_S = 0.002  # of the children: they have many interrupts to wait for

Compute = Callable[[], str]


def digest(arrays: object) -> str:
    """Hash of every bit of a pytree."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(arrays)]
    return hashlib.sha256(b"".join(leaf.tobytes() for leaf in leaves)).hexdigest()


def rollout() -> Compute:
    """A jitted scan of ant_uni: about a tenth of a second, 600 callbacks."""
    env = newton_qd.create("ant_uni", batch_size=2)

    @jax.jit
    def run(key: jax.Array) -> tuple:
        actions = jax.random.uniform(key, (300, 2, 8), jnp.float32, -1.0, 1.0)

        def advance(state, action):
            state = env.step(state, action)
            return state, (state.obs, state.reward)

        return jax.lax.scan(advance, env.reset(key), actions)[1]

    return lambda: digest(run(jax.random.key(0)))


def gradient() -> Compute:
    """A control step and its adjoint: every kind of callback of a run."""
    system = physics.load_system(ANT)
    start = physics.initial_state(system, jnp.asarray(system.rest_q), jnp.zeros(14))

    @jax.jit
    @jax.value_and_grad
    def run(action: jax.Array) -> jax.Array:
        return physics.step(system, start, action)[0].v.sum()

    return lambda: digest(run(jnp.full((8,), 0.5, jnp.float32)))


def child_random_moments() -> None:
    """Computes over and over; a line for each interrupt, then ``done``."""
    compute = rollout()
    expected = compute()
    assert compute() == expected
    print("ready", flush=True)
    for _ in range(INTERRUPTS):
        try:
            while True:
                assert compute() == expected, "wrong result"
        except KeyboardInterrupt:
            print("interrupted", flush=True)
    assert compute() == expected, "wrong result"
    print("done", flush=True)


class InterruptAt:
    """Profiler that sends an interrupt at one moment of the callbacks of a run.

    Python runs signal handlers when a function is entered and after a call into C:
    those are the moments, counted from 1.
    """

    def __init__(self, moment: int) -> None:
        self.moment = moment
        self.count = 0

    def __call__(self, frame: FrameType, event: str, argument: object) -> None:
        if event not in ("call", "c_return") or not _in_callback(frame):
            return
        self.count += 1
        if self.count == self.moment:
            sys.setprofile(None)
            signal.raise_signal(signal.SIGINT)


def _in_callback(frame: FrameType | None) -> bool:
    """Whether XLA has called into Warp; told apart by file, not by function."""
    while frame is not None:
        if frame.f_code.co_filename == ffi_module().__file__:
            return True
        frame = frame.f_back
    return False


def child_moments_of_a_callback() -> None:
    """Interrupts a run at the first moments of its callbacks, and at others."""
    interrupts._RETRY_SECONDS = RETRY_S
    compute = gradient()
    expected = compute()
    counter = InterruptAt(0)
    sys.setprofile(counter)
    assert compute() == expected
    sys.setprofile(None)
    others = range(ENTRY + 1, counter.count + 1)
    others = random.Random(6).sample(others, min(MOMENTS, len(others)))
    for moment in (*range(1, ENTRY + 1), *others):
        found, interrupted, profiler = None, False, InterruptAt(moment)
        try:
            sys.setprofile(profiler)
            found = compute()
            sys.setprofile(None)
            if profiler.count == moment:
                time.sleep(5.0)
        except KeyboardInterrupt:
            interrupted = True
        assert interrupted or profiler.count < moment, f"lost at moment {moment}"
        assert found in (None, expected), f"wrong result at moment {moment}"
        assert compute() == expected, f"wrong result after moment {moment}"
    print("done", flush=True)


def with_callbacks() -> None:
    """Lets XLA call Python for the physics, as it does on a GPU."""
    row_calls.native = lambda device: False


def start(child: Callable[[], None], errors: Path, device: jax.Device, callbacks: bool):
    """Starts a child; its standard error goes to a file."""
    platform = {"cpu": "cpu", "gpu": "cuda"}[device.platform]
    environment = os.environ | {
        "JAX_PLATFORMS": platform,
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
        "PYTHONFAULTHANDLER": "1",
    }
    with errors.open("w", encoding="utf-8") as stderr:
        return processes.start(
            [sys.executable, __file__, child.__name__, str(callbacks)],
            seconds=TIMEOUT_S,
            stderr=stderr,
            env=environment,
        )


def check_end(process: subprocess.Popen, errors: Path) -> None:
    """No crash, and nothing that ctypes or Python swallowed."""
    assert process.stdout is not None
    rest = process.stdout.read()
    status = process.wait()
    said = errors.read_text(encoding="utf-8")
    assert status == 0, f"exit status {status}: {said}"
    assert rest.endswith("done\n")
    for trouble in ("ignored", "Traceback", "Fatal Python error"):
        assert trouble not in said, said


@pytest.mark.slow
@pytest.mark.usefixtures("sigint")
@pytest.mark.parametrize("callbacks", [False, True], ids=["native", "callbacks"])
def test_random_moments(tmp_path: Path, device: jax.Device, callbacks: bool) -> None:
    rng = random.Random(5)
    errors = tmp_path / "stderr"
    with start(child_random_moments, errors, device, callbacks) as process:
        try:
            assert process.stdout is not None
            for line in process.stdout:
                if line == "ready\n":
                    break
            for _ in range(INTERRUPTS):
                time.sleep(rng.uniform(0.0, 0.3))
                process.send_signal(signal.SIGINT)
                line = process.stdout.readline()
                assert line == "interrupted\n", (line, errors.read_text())
            check_end(process, errors)
        finally:
            process.kill()


@pytest.mark.slow
@pytest.mark.usefixtures("sigint")
def test_moments_of_a_callback(tmp_path: Path, device: jax.Device) -> None:
    errors = tmp_path / "stderr"
    with start(child_moments_of_a_callback, errors, device, True) as process:
        try:
            check_end(process, errors)
        finally:
            process.kill()


COMMAND = """
import gc, os, signal, sys
from newton_qd import cli

sent = []

def _xla_gc_callback(phase, info):
    # Python drops an exception of this function, which has the name of JAX's own
    if not sent and "newton_qd.viewing.video" in sys.modules:
        sent.append(phase)
        os.kill(os.getpid(), signal.SIGINT)

gc.callbacks.append(_xla_gc_callback)
code = cli.main(["render", "pointmaze", "--steps", "3", "--png"])
assert sent and code == cli.INTERRUPTED, (sent, code)
"""


@pytest.mark.usefixtures("sigint")
def test_a_command_loses_no_interrupt(tmp_path: Path) -> None:
    root = str(Path(newton_qd.__file__).parent.parent)
    done = run_python(COMMAND, tmp_path, PYTHONPATH=root)
    assert done.returncode == 0, done.stderr
    assert "ignored" not in done.stderr


if __name__ == "__main__":
    warnings.filterwarnings("error", module="newton_qd|__main__")
    if sys.argv[2] == "True":
        with_callbacks()
    children = (child_random_moments, child_moments_of_a_callback)
    {child.__name__: child for child in children}[sys.argv[1]]()
