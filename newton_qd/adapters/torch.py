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

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.envs.base import Env
from newton_qd.envs.state import State
from newton_qd.errors import MissingExtra
from newton_qd.types import Params, PyTree

try:
    import torch
    from torch.autograd.function import once_differentiable
except ModuleNotFoundError as error:
    raise MissingExtra("torch", "torch") from error


_ARRAY = "_newton_qd_array"
"""Attribute of a tensor that a step returned: its array, which shares its memory.

An exchange takes about 70 microseconds of Python, and a state has twenty leaves.
"""


TorchState: TypeAlias = Any
"""A ``newton_qd.State`` whose leaves are tensors."""


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

    The leaves of a state are tensors: ``state.obs``, ``state.reward``, and the others
    too. Values are bitwise those of ``jax.jit(env.step)``. Tensors of a state share
    their memory with JAX, so never change one in place.

    Args:
        env: An environment of one world or of a batch, such as
            ``newton_qd.create("ant", batch_size=64, auto_reset=False)``.

    Returns:
        ``(reset, step)``. Both compile at their first call. ``step`` raises
        ``ValueError`` if tensors are on different devices, and all errors of
        ``env.step``.

    Raises:
        TypeError: ``env`` is not an environment.
    """
    checks.instance("env", env, Env, "an environment, as newton_qd.create makes it")
    door = _Door(env)
    return TorchEnv(door.reset, door.step)


def detached(tree: PyTree) -> PyTree:
    """Returns a state whose gradient goes back no further.

    Args:
        tree: A state, or another pytree of tensors.
    """
    return jax.tree.map(
        lambda leaf: leaf.detach() if isinstance(leaf, torch.Tensor) else leaf, tree
    )


def to_torch(leaf: Any) -> Any:
    """Returns an array of JAX as a tensor that shares its memory.

    Args:
        leaf: An array. Random keys stay what they are: PyTorch has no such type.
    """
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return leaf
    tensor = torch.from_dlpack(leaf)
    setattr(tensor, _ARRAY, leaf)
    return tensor


def to_jax(leaf: Any) -> Any:
    """Returns a tensor as an array of JAX that shares its memory.

    Args:
        leaf: A tensor; other leaves stay what they are. A tensor with gaps in its
            memory is copied.
    """
    if not isinstance(leaf, torch.Tensor):
        return leaf
    known = getattr(leaf, _ARRAY, None)
    if known is not None:
        return known
    return jax.dlpack.from_dlpack(leaf.detach().contiguous())


class _Door:
    """The compiled functions of an environment."""

    def __init__(self, env: Env) -> None:
        self._reset = jax.jit(env.reset)
        self.run = jax.jit(env.step)
        self.linearize = jax.jit(lambda inputs: _linearized(env, inputs))
        self.pull = jax.jit(lambda pull, slopes: pull(slopes)[0])

    def reset(self, seed: int) -> TorchState:
        """Begins an episode in every world.

        Args:
            seed: Seed of ``jax.random.key``.

        Raises:
            ValueError: ``seed`` is not an integer from 0.
        """
        checks.integer("seed", seed, least=0, most=2**32 - 1)
        return jax.tree.map(to_torch, self._reset(jax.random.key(seed)))

    def step(
        self, state: TorchState, action: torch.Tensor, params: Params = None
    ) -> TorchState:
        """Advances every world by one control step.

        Args:
            state: A state that ``reset`` or ``step`` returned.
            action: (..., nu) actions.
            params: Physical parameters; ``None``: the default ones.

        Raises:
            TypeError: The action is not a tensor.
            ValueError: Tensors are on different devices.
        """
        checks.instance("action", action, torch.Tensor, "a tensor of PyTorch")
        leaves, structure = jax.tree.flatten((state, action, params))
        tensors = [leaf for leaf in leaves if isinstance(leaf, torch.Tensor)]
        for tensor in tensors:
            if tensor.device != action.device:
                given = Fact(f"a tensor on {action.device}")
                raise ValueError(message("action", given, f"one on {tensor.device}"))
        if torch.is_grad_enabled() and any(x.requires_grad for x in tensors):
            found: list[Any] = []
            results = _Step.apply(self, structure, found, *leaves)
            return jax.tree.unflatten(found[0], results)
        inputs = jax.tree.unflatten(structure, [to_jax(leaf) for leaf in leaves])
        return jax.tree.map(to_torch, self.run(*inputs))


def _moves(leaf: Any) -> bool:
    """Returns whether an array or tensor has a gradient."""
    if isinstance(leaf, torch.Tensor):
        return leaf.is_floating_point()
    return jnp.issubdtype(leaf.dtype, jnp.floating)


def _linearized(env: Env, inputs: PyTree) -> tuple[State, Callable[..., Any]]:
    """Returns the next state, and its gradient as a function that is a pytree."""
    leaves, structure = jax.tree.flatten(inputs)

    def step(moving: list[jax.Array]) -> tuple[list[jax.Array], State]:
        rest = iter(moving)
        merged = [next(rest) if _moves(leaf) else leaf for leaf in leaves]
        state = env.step(*jax.tree.unflatten(structure, merged))
        return [leaf for leaf in jax.tree.leaves(state) if _moves(leaf)], state

    moving = [leaf for leaf in leaves if _moves(leaf)]
    _, pull, state = jax.vjp(step, moving, has_aux=True)
    return state, pull


class _Step(torch.autograd.Function):
    """A step as an operation of PyTorch's graph."""

    @staticmethod
    def forward(
        ctx: Any, door: _Door, structure: Any, found: list[Any], *leaves: Any
    ) -> tuple[Any, ...]:
        """Runs the step; appends the structure of its result to ``found``."""
        inputs = jax.tree.unflatten(structure, [to_jax(leaf) for leaf in leaves])
        state, ctx.pull = door.linearize(inputs)
        arrays, made = jax.tree.flatten(state)
        found.append(made)
        results = tuple(to_torch(array) for array in arrays)
        ctx.door = door
        ctx.moving = [_moves(leaf) for leaf in leaves], [_moves(x) for x in arrays]
        tensors = [x for x in results if isinstance(x, torch.Tensor)]
        ctx.mark_non_differentiable(*(x for x in tensors if not _moves(x)))
        # PyTorch then finds tensors that somebody changed before the way back
        given = [x for x in leaves if isinstance(x, torch.Tensor)]
        ctx.save_for_backward(*given, *tensors)
        return results

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Any) -> tuple[Any, ...]:
        """Returns the gradient of every leaf of the inputs.

        Raises:
            RuntimeError: A tensor was changed in place after the step.
        """
        _ = ctx.saved_tensors  # raises the error
        inputs, outputs = ctx.moving
        chosen = zip(slopes, outputs, strict=True)
        given = [to_jax(slope) for slope, moves in chosen if moves]
        gradients = iter(ctx.door.pull(ctx.pull, given))
        found = [to_torch(next(gradients)) if moves else None for moves in inputs]
        return None, None, None, *found
