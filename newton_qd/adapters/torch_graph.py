"""A step as an operation of PyTorch's graph."""

# Without PyTorch, pyright takes torch.py for the package of its name.
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false
from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import torch

from newton_qd.adapters.torch_state import FIELDS, to_jax, to_torch
from newton_qd.envs.state import State
from newton_qd.types import PyTree


class Door(Protocol):
    """The two halves of a step with gradient, compiled."""

    linearize: Callable[..., Any]
    pull: Callable[..., Any]


def parts_of(state: State) -> dict[str, Any]:
    """Returns the attributes of a state by name."""
    return {name: getattr(state, name) for name in FIELDS}


def moves(leaf: Any) -> bool:
    """Returns whether an array or tensor has a gradient."""
    if isinstance(leaf, torch.Tensor):
        return leaf.is_floating_point()
    return jnp.issubdtype(leaf.dtype, jnp.floating)


def linearized(
    run: Callable[..., State], inputs: PyTree
) -> tuple[State, Callable[..., Any]]:
    """Returns the next state, and its gradient as a function that is a pytree."""
    leaves, structure = jax.tree.flatten(inputs)

    def step(moving: list[jax.Array]) -> tuple[list[jax.Array], State]:
        rest = iter(moving)
        merged = [next(rest) if moves(leaf) else leaf for leaf in leaves]
        state = run(*jax.tree.unflatten(structure, merged))
        moved = [leaf for leaf in jax.tree.leaves(parts_of(state)) if moves(leaf)]
        return moved, state

    moving = [leaf for leaf in leaves if moves(leaf)]
    _, pull, state = jax.vjp(step, moving, has_aux=True)
    return state, pull


def pulled(
    pull: Callable[..., Any],
    slopes: list[jax.Array | None],
    shapes: tuple[jax.ShapeDtypeStruct, ...],
    wanted: tuple[bool, ...],
) -> list[jax.Array]:
    """Returns the gradients of the inputs that are wanted.

    Args:
        pull: What ``linearized`` returned.
        slopes: Gradient of the loss with respect to each result; ``None``: zero.
        shapes: Shapes and types of the results.
        wanted: Which inputs are wanted.
    """
    pairs = zip(slopes, shapes, strict=True)
    given = [jnp.zeros(x.shape, x.dtype) if s is None else s for s, x in pairs]
    (found,) = pull(given)
    return [slope for slope, want in zip(found, wanted, strict=True) if want]


class Step(torch.autograd.Function):
    """A step as an operation of PyTorch's graph."""

    @staticmethod
    def forward(
        ctx: Any, door: Door, inputs: PyTree, found: list[State], *leaves: Any
    ) -> tuple[Any, ...]:
        """Runs the step; appends its result to ``found``."""
        state, ctx.pull = door.linearize(inputs)
        found.append(state)
        arrays = jax.tree.leaves(parts_of(state))
        results = tuple(to_torch(array) for array in arrays)
        ctx.door, ctx.moving = door, tuple(map(moves, leaves))
        ctx.shapes = tuple(
            jax.ShapeDtypeStruct(x.shape, x.dtype) if moves(x) else None for x in arrays
        )
        ctx.set_materialize_grads(False)
        tensors = [x for x in results if isinstance(x, torch.Tensor)]
        ctx.mark_non_differentiable(*(x for x in tensors if not moves(x)))
        # PyTorch then finds tensors that somebody changed before the way back
        given = [x for x in leaves if isinstance(x, torch.Tensor)]
        ctx.save_for_backward(*given, *tensors)
        return results

    @staticmethod
    def backward(ctx: Any, *slopes: Any) -> tuple[Any, ...]:
        """Returns the gradient of every leaf of the inputs that needs one.

        Raises:
            RuntimeError: A tensor was changed in place after the step.
        """
        return None, None, None, *Back.apply(ctx, slopes, *ctx.saved_tensors, *slopes)


class Back(torch.autograd.Function):
    """The way back as an operation of the graph, if PyTorch makes one of it."""

    @staticmethod
    def forward(
        ctx: Any, step: Any, slopes: tuple[Any, ...], *_tensors: Any
    ) -> tuple[Any, ...]:
        """Returns the gradients. All that they depend on is among the inputs.

        Raises:
            RuntimeError: The slopes are a batch.
        """
        del ctx
        pairs = zip(slopes, step.shapes, strict=True)
        try:
            given = [to_jax(slope) for slope, shape in pairs if shape is not None]
        except TypeError as error:
            raise RuntimeError(
                "newton_qd.adapters.torch has no batches of slopes; allowed: one "
                "gradient at a time, without vectorize or is_grads_batched"
            ) from error
        shapes = tuple(shape for shape in step.shapes if shape is not None)
        needed = step.needs_input_grad[3:]
        moving = zip(needed, step.moving, strict=True)
        wanted = tuple(need for need, has_slope in moving if has_slope)
        found = iter(step.door.pull(step.pull, given, shapes, wanted))
        return tuple(to_torch(next(found)) if need else None for need in needed)

    @staticmethod
    def backward(ctx: Any, *slopes: Any) -> Any:
        """Says that there are no second derivatives.

        Raises:
            RuntimeError: Always.
        """
        raise RuntimeError(
            "newton_qd has no second derivatives; allowed: first derivatives, and "
            "detach() before a gradient is used in another one"
        )
