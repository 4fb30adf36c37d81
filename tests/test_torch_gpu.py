"""The door to PyTorch on a GPU: streams in order, memory shared, gradients right.

    python -m pytest -n 0 tests/test_torch_gpu.py

It needs PyTorch and JAX with CUDA; without them, it is skipped.
"""

from __future__ import annotations

import importlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import newton_qd

pytestmark = pytest.mark.gpu
WORLDS, STEPS = 256, 32
LATE = 2_000_000  # clock cycles of a GPU, about a millisecond


@pytest.fixture(scope="module")
def torch() -> Any:
    found = pytest.importorskip("torch")
    if not found.cuda.is_available():
        pytest.skip("this PyTorch has no CUDA")
    return found


@pytest.fixture(scope="module")
def door(torch: Any) -> Any:
    return importlib.import_module("newton_qd.adapters.torch")


@pytest.fixture(scope="module")
def env() -> Any:
    return newton_qd.create(
        "hopper_uni",
        batch_size=WORLDS,
        auto_reset=False,
        qdax_wrappers_kwargs=[{"smooth_width": 0.02}],
    )


def values(env: Any) -> np.ndarray:
    rng = np.random.default_rng(0)
    shape = (STEPS, WORLDS, env.action_size)
    return rng.uniform(-1, 1, shape).astype(np.float32)


def expected(env: Any) -> np.ndarray:
    """Observations (STEPS, WORLDS, no) of JAX alone."""
    state, step = jax.jit(env.reset)(jax.random.key(0)), jax.jit(env.step)
    found = []
    for action in values(env):
        state = step(state, jnp.asarray(action))
        found.append(np.asarray(state.obs))
    return np.stack(found)


def test_memory_is_shared(torch: Any, door: Any) -> None:
    tensor = torch.arange(6.0, device="cuda").reshape(2, 3)
    door = importlib.import_module("newton_qd.adapters.torch_state")
    array = door.to_jax(tensor)
    assert array.unsafe_buffer_pointer() == tensor.data_ptr()
    assert door.to_torch(array).data_ptr() == tensor.data_ptr()


@pytest.mark.parametrize("tracked", [False, True])
def test_a_step_waits_for_late_actions(
    torch: Any, door: Any, env: Any, tracked: bool
) -> None:
    """Actions are written late, and written over as soon as the step has begun."""
    reset, step = door.make_torch_step(env)
    plan, found = torch.as_tensor(values(env), device="cuda"), []
    torch.cuda.synchronize()
    for stream in (torch.cuda.Stream(), torch.cuda.current_stream()):
        found.clear()
        with torch.cuda.stream(stream):
            state = reset(0)
            for row in plan:
                torch.cuda._sleep(LATE)
                action = row.clone().requires_grad_(tracked)
                state = door.detached(step(state, action))
                with torch.no_grad():
                    action.fill_(torch.nan)
                found.append(state.obs.clone())
        torch.cuda.synchronize()
        rows = torch.stack(found).detach().cpu().numpy()
        np.testing.assert_array_equal(rows, expected(env))


def test_gradients_are_those_of_jax(torch: Any, door: Any, env: Any) -> None:
    """Also on a stream of its own, where the slope is written late."""
    reset, step = door.make_torch_step(env)
    first = jax.jit(env.reset)(jax.random.key(0))

    def total(plan: jax.Array) -> jax.Array:
        def advance(state: Any, action: jax.Array) -> tuple[Any, jax.Array]:
            state = env.step(state, action)
            return state, state.reward.sum() + state.obs.sum()

        return jax.lax.scan(advance, first, plan)[1].sum()

    wanted = np.asarray(jax.jit(jax.grad(total))(jnp.asarray(values(env)[:8])))
    for stream in (torch.cuda.Stream(), torch.cuda.current_stream()):
        with torch.cuda.stream(stream):
            plan = torch.as_tensor(values(env)[:8], device="cuda").requires_grad_()
            state, loss = reset(0), torch.zeros((), device="cuda")
            for row in plan:
                state = step(state, row)
                loss = loss + state.reward.sum() + state.obs.sum()
            torch.cuda._sleep(LATE)
            loss.backward()
        torch.cuda.synchronize()
        scale = np.abs(wanted).max()
        np.testing.assert_allclose(plan.grad.cpu().numpy(), wanted, atol=1e-4 * scale)


def test_memory_does_not_grow(torch: Any, door: Any, env: Any) -> None:
    reset, step = door.make_torch_step(env)
    action = torch.zeros(WORLDS, env.action_size, device="cuda", requires_grad=True)
    device = jax.devices("gpu")[0]

    def held() -> int:
        torch.cuda.synchronize()
        return torch.cuda.memory_allocated() + device.memory_stats()["bytes_in_use"]

    state, sizes = reset(0), []
    for number in range(1000):
        state = step(state, action)
        if number % 8 == 7:
            state.reward.sum().backward()
            action.grad = None
            state = door.detached(state)
        if number in (200, 999):
            sizes.append(held())
    # states of some steps may wait for the garbage collector
    assert sizes[1] < 1.1 * sizes[0]
