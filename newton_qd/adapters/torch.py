"""Reset and step for PyTorch, with gradients.

States and actions are tensors. They share their memory with the arrays of JAX over
DLPack, on the CPU and on a GPU: nothing is copied.

On a GPU, PyTorch and JAX have streams of their own. Each exchange over DLPack orders
them: JAX waits for the current stream of PyTorch before it reads the actions, and that
stream waits for JAX before PyTorch reads a result. Memory is safe if all calls are made
on one current stream. PyTorch reuses the memory of an input only after its stream has
waited for the results of the step. JAX reuses the memory of a result only in later
steps, which wait for that stream.
"""

# Without PyTorch, pyright takes this file for the package of its name.
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false
from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.envs.base import Env
from newton_qd.envs.state import State
from newton_qd.errors import MissingExtra
from newton_qd.physics.parameters import check_values
from newton_qd.types import Params, PyTree

try:
    import torch
    from torch.autograd import forward_ad

    from newton_qd.adapters.torch_graph import Step, linearized, parts_of, pulled
    from newton_qd.adapters.torch_state import TorchState, is_tracked, to_jax
except ModuleNotFoundError as error:
    raise MissingExtra("torch", "torch") from error


class TorchEnv(NamedTuple):
    """The two functions of an environment for PyTorch.

    Attributes:
        reset: Maps a seed to the state of ``env.reset(jax.random.key(seed))``.
        step: Maps a state and actions, and physical parameters if wanted, to the next
            state. Results have a gradient with respect to all tensors that require one.
    """

    reset: Callable[[int], TorchState]
    step: Callable[..., TorchState]


def make_torch_step(env: Env) -> TorchEnv:
    """Makes reset and step of an environment for PyTorch.

    Values are bitwise those of ``jax.jit(env.step)``. Tensors of a state share their
    memory with JAX, so never change one in place.

    Args:
        env: An environment of one world or of a batch, such as
            ``newton_qd.create("ant", batch_size=64, auto_reset=False)``.

    Returns:
        ``(reset, step)``. Both compile at their first call. ``step`` raises
        ``ValueError`` if the actions are on another device than the state,
        ``TypeError`` under ``torch.func`` (and another error under
        ``torch.compile``), and all errors of ``env.step``. Forward-mode and second
        derivatives raise ``RuntimeError``.

    Raises:
        TypeError: ``env`` is not an environment.
    """
    checks.instance("env", env, Env, "an environment, as newton_qd.create makes it")
    door = _Door(env)
    return TorchEnv(door.reset, door.step)


def detached(state: TorchState) -> TorchState:
    """Returns a state whose gradient goes back no further.

    Args:
        state: A state.

    Raises:
        TypeError: A leaf of it is no tensor of PyTorch.
    """
    return TorchState(State(**state.as_arrays()), {})


class _Door:
    """The compiled functions of an environment."""

    def __init__(self, env: Env) -> None:
        def run(parts: dict[str, Any], action: jax.Array, params: Params) -> State:
            return env.step(State(**parts), action, params)

        self._reset = jax.jit(env.reset)
        self._run = jax.jit(run)
        self.linearize = jax.jit(functools.partial(linearized, run))
        self.pull = jax.jit(pulled, static_argnums=(2, 3))

    def reset(self, seed: int) -> TorchState:
        """Begins an episode in every world.

        Args:
            seed: Seed of ``jax.random.key``.

        Raises:
            ValueError: ``seed`` is not an integer from 0.
        """
        checks.integer("seed", seed, least=0, most=2**32 - 1)
        return TorchState(self._reset(jax.random.key(seed)), {})

    def step(
        self, state: TorchState, action: torch.Tensor, params: Params = None
    ) -> TorchState:
        """Advances every world by one control step.

        Args:
            state: A state that ``reset`` or ``step`` returned.
            action: (..., nu) actions.
            params: Physical parameters; ``None``: the default ones.

        Raises:
            RuntimeError: A tensor has a tangent of forward mode.
            TypeError: The state is not one of PyTorch, or the action is not a tensor
                with memory of its own.
            ValueError: The action is on another device than the state, or a physical
                parameter is out of bounds.
        """
        checks.instance("state", state, TorchState, "a state of reset or step")
        checks.instance("action", action, torch.Tensor, "a tensor of PyTorch")
        parts = state.as_arrays()
        if action.device != state.obs.device:
            wrong = Fact(f"a tensor on {action.device}")
            raise ValueError(message("action", wrong, f"one on {state.obs.device}"))
        given = jax.tree.map(lambda x: to_jax(x, "params"), params)
        check_values(given)
        if forward_ad._current_level >= 0:  # then the tensors of the state are made
            _check_forward((state.parts, action, params))
        tracked = action.requires_grad or state.tracked
        tracked = tracked or (params is not None and is_tracked(params))
        if not tracked or not torch.is_grad_enabled():
            array = to_jax(action, "action", numpy=action.device.type == "cpu")
            after = TorchState(self._run(parts, array, given), {})
            after.obs  # noqa: B018 - waits for the step: the inputs may change now
            return after
        found: list[State] = []
        inputs = parts, to_jax(action, "action"), given
        leaves = jax.tree.leaves((state.parts, action, params))
        results = Step.apply(self, inputs, found, *leaves)
        structure = jax.tree.structure(parts_of(found[0]))
        return TorchState(found[0], jax.tree.unflatten(structure, results))


def _check_forward(tree: PyTree) -> None:
    """Checks that no tensor has a tangent, which a step would drop.

    Raises:
        RuntimeError: A tensor has a tangent.
    """
    for leaf in jax.tree.leaves(tree):
        if isinstance(leaf, torch.Tensor):
            if forward_ad.unpack_dual(leaf).tangent is not None:
                raise RuntimeError(
                    "newton_qd.adapters.torch has no forward-mode derivatives; "
                    "allowed: torch.autograd.grad and backward"
                )
