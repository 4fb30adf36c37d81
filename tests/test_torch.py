"""The door to PyTorch: the same numbers, the same gradients, the same memory."""

from __future__ import annotations

import copy
import dataclasses
import importlib
import re
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import newton_qd

ROOT = Path(__file__).resolve().parent.parent
STEPS, WORLDS = 3, 2


def test_a_missing_torch_says_its_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "newton_qd.adapters.torch", raising=False)
    with pytest.raises(newton_qd.MissingExtra, match=r"newton_qd\[torch\]"):
        importlib.import_module("newton_qd.adapters.torch")


@pytest.fixture(scope="module")
def torch(device: Any) -> Iterator[Any]:
    """PyTorch, which makes its tensors where JAX computes."""
    found = pytest.importorskip("torch")
    found.set_default_device("cpu" if device.platform == "cpu" else "cuda")
    yield found
    found.set_default_device("cpu")


@pytest.fixture(scope="module")
def door(torch: Any) -> Any:
    return importlib.import_module("newton_qd.adapters.torch")


@pytest.fixture(scope="module")
def hopper() -> Any:
    return newton_qd.create(
        "hopper_uni",
        batch_size=WORLDS,
        auto_reset=False,
        qdax_wrappers_kwargs=[{"smooth_width": 0.02}],
    )


@pytest.fixture(scope="module")
def maze() -> Any:
    return newton_qd.create("pointmaze", batch_size=WORLDS, episode_length=4)


def same(state: Any, wanted: Any) -> bool:
    arrays = {name: getattr(wanted, name) for name in state.parts}
    assert len(arrays) == 6
    pairs = zip(jax.tree.leaves(state), jax.tree.leaves(arrays), strict=True)
    return all(np.array_equal(a.detach().cpu().numpy(), b) for a, b in pairs)


@pytest.mark.usefixtures("door")
def test_memory_is_shared(torch: Any) -> None:
    door = importlib.import_module("newton_qd.adapters.torch_state")
    tensor = torch.arange(6.0).reshape(2, 3)
    array = door.to_jax(tensor)
    assert array.unsafe_buffer_pointer() == tensor.data_ptr()
    back = door.to_torch(array)
    assert back.data_ptr() == tensor.data_ptr()
    assert np.array_equal(door.to_jax(tensor.T), tensor.T.cpu().numpy()), "gaps: copied"
    key = jax.random.key(0)
    assert door.to_torch(key) is key and door.to_jax(key) is key


def test_the_numbers_are_those_of_env_step(torch: Any, door: Any, maze: Any) -> None:
    """Also where worlds reset themselves, with and without a graph."""
    reset, step = door.make_torch_step(maze)
    wanted, env_step = jax.jit(maze.reset)(jax.random.key(7)), jax.jit(maze.step)
    plain = graph = reset(7)
    actions = torch.zeros(WORLDS, 2)
    assert same(plain, wanted)
    for number in range(6):
        actions = torch.linspace(-1, 1, 2 * WORLDS).reshape(WORLDS, 2) / (1 + number)
        wanted = env_step(wanted, actions.cpu().numpy())
        plain = step(plain, actions)
        graph = step(graph, actions.clone().requires_grad_())
        assert same(plain, wanted) and same(graph, wanted)
        assert not plain.obs.requires_grad and graph.obs.requires_grad
    with torch.no_grad():
        assert not step(graph, actions).obs.requires_grad
    plain = step(reset(0), actions)
    step(plain, actions)
    assert not {"reward", "pipeline_state", "info"} & set(vars(plain)), "not read"


@pytest.mark.slow
@pytest.mark.optimized
def test_gradients_are_those_of_jax(torch: Any, door: Any, hopper: Any) -> None:
    """Through several steps, with respect to actions and to the first state."""
    reset, step = door.make_torch_step(hopper)

    def total(advance: Any, first: Any, q: Any, plan: Any) -> Any:
        physics = dataclasses.replace(first.pipeline_state, q=q)
        state, found = first.replace(pipeline_state=physics), 0.0
        for number in range(STEPS):
            state = advance(state, plan[number])
            read = state.reward.sum() + state.info["state_descriptor"].sum()
            found = found + read + 0.1 * (state.obs**2).sum()
        return found

    values = np.linspace(-0.5, 0.5, STEPS * WORLDS * 3, dtype=np.float32)
    values = values.reshape(STEPS, WORLDS, 3)
    first, start = reset(1), jax.jit(hopper.reset)(jax.random.key(1))
    q = first.pipeline_state.q.clone().requires_grad_()
    plan = torch.tensor(values, requires_grad=True)
    found = total(step, first, q, plan)
    found.backward()

    def value(q: jax.Array, plan: jax.Array) -> jax.Array:
        return total(jax.jit(hopper.step), start, q, plan)

    given = start.pipeline_state.q, jnp.asarray(values)
    wanted, slopes = jax.value_and_grad(value, (0, 1))(*given)
    assert float(found.detach()) == pytest.approx(float(wanted), rel=1e-6)
    for tensor, slope in zip((q, plan), slopes, strict=True):
        scale = float(jnp.abs(slope).max())
        assert scale > 0.1
        error = np.abs(tensor.grad.cpu().numpy() - np.asarray(slope)).max()
        assert error < 1e-6 * scale


def test_a_gradient_of_every_part(torch: Any, door: Any, maze: Any) -> None:
    """An action alone, a state alone, and nothing beyond a cut."""
    reset, step = door.make_torch_step(maze)
    actions = torch.full((WORLDS, 2), 0.3, requires_grad=True)
    first = reset(0)
    state = step(first, actions)
    state.reward.sum().backward()
    slope = jax.grad(lambda a: maze.step(start, a).reward.sum())
    start = maze.reset(jax.random.key(0))
    expected = slope(np.full((WORLDS, 2), 0.3, np.float32))
    assert np.allclose(actions.grad.cpu().numpy(), expected, rtol=1e-6, atol=0)
    cut = door.detached(step(first, actions))
    assert not any(leaf.requires_grad for leaf in jax.tree.leaves(cut))
    observed = first.replace(obs=first.obs.clone().requires_grad_())
    step(observed, actions.detach()).reward.sum().backward()
    assert torch.isfinite(observed.obs.grad).all() and observed.obs.grad.any()


def test_one_world_and_physical_parameters(torch: Any, door: Any) -> None:
    one = newton_qd.create("pointmaze", auto_reset=False)
    reset, step = door.make_torch_step(one)
    assert step(reset(0), torch.zeros(2)).obs.shape == (2,)
    with pytest.raises(ValueError, match="params"):
        step(reset(0), torch.zeros(2), torch.ones(2))


def test_physical_parameters_are_checked(torch: Any, door: Any, hopper: Any) -> None:
    reset, step = door.make_torch_step(hopper)
    state, params = reset(0), hopper.default_params
    for name in ("friction", "gear_scale"):
        wrong = params.replace(**{name: -getattr(params, name)})
        with pytest.raises(ValueError, match=rf"^params\.{name}: got -.*from 0$"):
            step(state, torch.zeros(WORLDS, 3), wrong)


def test_a_state_has_no_other_attributes(door: Any, maze: Any) -> None:
    state = door.make_torch_step(maze).reset(0)
    with pytest.raises(TypeError, match=r"^rewrad: got 5; allowed: one of pipe"):
        state.replace(rewrad=5)


def test_errors(torch: Any, door: Any, maze: Any) -> None:
    reset, step = door.make_torch_step(maze)
    state = reset(0)
    with pytest.raises(TypeError, match="env: got 3; allowed: an environment"):
        door.make_torch_step(cast("Any", 3))
    with pytest.raises(ValueError, match="seed: got -1; allowed: integers from 0"):
        reset(-1)
    with pytest.raises(TypeError, match=r"action: got .*; allowed: a tensor"):
        step(state, np.zeros((WORLDS, 2), np.float32))
    with pytest.raises(TypeError, match=r"state: got .*; allowed: a state of reset"):
        step(state.arrays, torch.zeros(WORLDS, 2))
    with pytest.raises(ValueError, match="action: got a tensor on meta; allowed: one"):
        step(state, torch.zeros(WORLDS, 2, device="meta"))
    with pytest.raises(ValueError, match="action: got an array of shape"):
        step(state, torch.zeros(WORLDS, 3))
    with pytest.raises(TypeError, match=r"action: got an array of float16"):
        step(state, torch.zeros(WORLDS, 2, dtype=torch.float16))


def test_a_tensor_of_a_state_may_begin_to_need_a_gradient(
    torch: Any, door: Any, maze: Any
) -> None:
    reset, step = door.make_torch_step(maze)
    state, actions = reset(0), torch.full((WORLDS, 2), 0.3)
    state.obs.requires_grad_()
    step(state, actions).obs.sum().backward()
    assert state.obs.grad.any()


def test_a_state_is_frozen_but_for_its_dictionaries(
    torch: Any, door: Any, maze: Any
) -> None:
    """A step goes on from what a reader sees."""
    reset, step = door.make_torch_step(maze)
    state, actions = reset(0), torch.zeros(WORLDS, 2)
    with pytest.raises(dataclasses.FrozenInstanceError, match=r"state\.replace\(obs="):
        state.obs = state.obs + 1
    state.info["steps"] = torch.ones_like(state.info["steps"])
    cut = door.detached(state)
    for copied in (state, cut, copy.copy(state), copy.deepcopy(state)):
        assert (step(copied, actions).info["steps"] == 2).all()
    renamed = reset(0)
    renamed.info["fault_"] = renamed.info.pop("fault")  # in the same place
    with pytest.raises(ValueError, match="info without 'fault'"):
        step(renamed, actions)
    with pytest.raises(TypeError, match=r"^state\.obs: got .*; allowed: tensors of"):
        step(state.replace(obs=state.obs.cpu().numpy()), actions)


def test_what_pytorch_cannot_do_here_is_an_error(
    torch: Any, door: Any, maze: Any
) -> None:
    reset, step = door.make_torch_step(maze)
    actions = torch.full((WORLDS, 2), 0.3, requires_grad=True)
    state = step(reset(0), actions)
    with torch.no_grad():
        actions.mul_(2.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        state.reward.sum().backward()
    given = torch.func.grad, torch.func.vmap
    for transform in given:
        with pytest.raises(TypeError, match=r"^action: got .*outside of torch\.func$"):
            transform(lambda action: step(reset(0), action).reward.sum())(actions)
    state, actions = reset(0), actions.detach()
    for transform in given:
        with pytest.raises(
            TypeError, match=r"^state\.obs: got .*outside of torch\.func$"
        ):
            transform(lambda o: step(state.replace(obs=o), actions).obs.sum())(
                state.obs
            )
    for wrong in (actions.bfloat16(), actions.detach().to_sparse()):
        with pytest.raises(TypeError, match=r"^action: got .*; allowed: an? "):
            step(reset(0), wrong)


def test_second_derivatives_are_an_error(torch: Any, door: Any, maze: Any) -> None:
    """Also of a loss that is linear in the results, and as part of a longer graph."""
    reset, step = door.make_torch_step(maze)
    first, autograd = reset(0), torch.autograd

    def linear(actions: Any) -> Any:
        return step(step(first, actions), actions).obs.sum()

    actions = torch.full((WORLDS, 2), 0.3, requires_grad=True)
    (slope,) = autograd.grad(linear(actions), actions, create_graph=True)
    assert slope.requires_grad
    for again in (
        lambda: (linear(actions) + (slope**2).sum()).backward(),
        lambda: autograd.grad(slope.sum(), actions),
        lambda: autograd.functional.hessian(linear, actions.detach()),
        lambda: autograd.functional.hvp(linear, actions.detach(), actions.detach()),
    ):
        with pytest.raises(RuntimeError, match="has no second derivatives"):
            again()


def test_forward_mode_and_batches_are_errors(torch: Any, door: Any, maze: Any) -> None:
    reset, step = door.make_torch_step(maze)
    first, actions = reset(0), torch.full((WORLDS, 2), 0.3)

    def loss(actions: Any) -> Any:
        return step(first, actions).reward.sum()

    forward = torch.autograd.forward_ad
    with forward.dual_level(), pytest.raises(RuntimeError, match="no forward-mode"):
        loss(forward.make_dual(actions, torch.ones_like(actions)))
    jacobian = torch.autograd.functional.jacobian
    with pytest.raises(RuntimeError, match="no forward-mode"):
        jacobian(loss, actions, strategy="forward-mode", vectorize=True)
    with pytest.raises(RuntimeError, match="no batches of slopes"):
        jacobian(loss, actions, vectorize=True)


def test_a_step_inside_of_a_compiled_function(torch: Any, door: Any, maze: Any) -> None:
    """With what docs/pytorch.md says; the slopes are those without a compiler."""
    reset, step = door.make_torch_step(maze)
    first = reset(0)

    def slopes(step: Any, around: Any) -> Any:
        actions = torch.full((WORLDS, 2), 0.3, requires_grad=True)
        around(lambda a: step(first, torch.tanh(a)).reward.sum())(actions).backward()
        return actions.grad

    found = slopes(
        torch.compiler.disable(step), lambda f: torch.compile(f, backend="eager")
    )
    assert torch.equal(found, slopes(step, lambda f: f))
    assert found.any()


@pytest.mark.slow
@pytest.mark.usefixtures("torch")
def test_the_example_runs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = ROOT / "examples" / "shac_torch.py"
    assert len(path.read_text(encoding="utf-8").splitlines()) < 80
    tiny = ["--worlds", "2", "--window", "4", "--iterations", "2"]
    monkeypatch.setattr(sys, "argv", [str(path), *tiny])
    runpy.run_path(str(path), run_name="__main__")
    printed = capsys.readouterr().out
    assert re.search(r"iteration   2: mean reward of a step +-?\d", printed)
