"""States whose leaves are tensors of PyTorch."""

# Without PyTorch, pyright takes torch.py for the package of its name.
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false
from __future__ import annotations

import dataclasses
import operator
from typing import Any

import jax
import jax.numpy as jnp
import torch

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.envs.state import State
from newton_qd.types import PyTree

FIELDS = tuple(field.name for field in dataclasses.fields(State))


class TorchState:
    """A :class:`newton_qd.State` whose leaves are tensors.

    It has the same attributes. Each becomes tensors when it is first read, so a step
    costs little. It is a pytree of tensors, and frozen: ``replace`` makes another one.

    Attributes:
        arrays: The same state with the arrays of JAX; ``None`` after ``replace``.
    """

    arrays: State | None

    pipeline_state: Any
    obs: Any
    reward: Any
    done: Any
    metrics: Any
    info: Any

    def __init__(self, arrays: State | None, parts: dict[str, Any]) -> None:
        """Makes a state.

        Args:
            arrays: State of JAX, if there is one.
            parts: Attributes that are tensors already; all of them without ``arrays``.
        """
        read = {name: jax.tree.flatten(part) for name, part in parts.items()}
        vars(self).update(parts, arrays=arrays, _read=read)

    def __getattr__(self, name: str) -> Any:
        if name not in FIELDS or self.arrays is None:
            kind = type(self).__name__
            raise AttributeError(f"{kind!r} object has no attribute {name!r}")
        value = jax.tree.map(to_torch, getattr(self.arrays, name))
        vars(self)[name] = value
        vars(self)["_read"][name] = jax.tree.flatten(value)
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        raise dataclasses.FrozenInstanceError(
            f"cannot assign to field {name!r}; allowed: state.replace({name}=...)"
        )

    def __repr__(self) -> str:
        return f"<TorchState: observation {tuple(self.obs.shape)}>"

    @property
    def parts(self) -> dict[str, Any]:
        """All attributes by name, as tensors."""
        return {name: getattr(self, name) for name in FIELDS}

    @property
    def tracked(self) -> bool:
        """Whether one of its tensors requires a gradient."""
        return is_tracked({name: vars(self).get(name) for name in FIELDS})

    def as_arrays(self) -> dict[str, Any]:
        """Returns all attributes by name, as arrays of JAX.

        Raises:
            TypeError: A leaf is no tensor of PyTorch.
        """
        return {name: self._array(name) for name in FIELDS}

    def _array(self, name: str) -> Any:
        """Returns an attribute as arrays: those of JAX, if it has not changed since.

        A dictionary of a state, such as ``info``, may have got another tensor.

        Raises:
            TypeError: A leaf is no tensor of PyTorch.
        """
        if self.arrays is not None:
            if name not in vars(self):
                return getattr(self.arrays, name)
            read, form = vars(self)["_read"][name]
            leaves, structure = jax.tree.flatten(getattr(self, name))
            if form == structure and all(map(operator.is_, read, leaves)):
                return getattr(self.arrays, name)
        for leaf in jax.tree.leaves(getattr(self, name)):
            if not isinstance(leaf, torch.Tensor | jax.Array):
                raise TypeError(message(f"state.{name}", leaf, "tensors of PyTorch"))
        return jax.tree.map(lambda x: to_jax(x, f"state.{name}"), getattr(self, name))

    def replace(self, **changes: Any) -> TorchState:
        """Returns a copy with some attributes replaced.

        Raises:
            TypeError: A state has no such attribute.
        """
        for name, value in changes.items():
            if name not in FIELDS:
                raise TypeError(message(name, value, f"one of {checks.listed(FIELDS)}"))
        return TorchState(None, {**self.parts, **changes})


jax.tree_util.register_pytree_node(
    TorchState,
    lambda state: ((state.parts,), None),
    lambda _, children: TorchState(None, *children),
)


def to_torch(leaf: Any) -> Any:
    """Returns an array of JAX as a tensor that shares its memory.

    Args:
        leaf: An array. Random keys stay what they are: PyTorch has no such type.
    """
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return leaf
    return torch.from_dlpack(leaf)


def to_jax(leaf: Any, name: str = "tensor", *, numpy: bool = False) -> Any:
    """Returns a tensor as an array that shares its memory.

    Args:
        leaf: A tensor; other leaves stay what they are. A tensor with gaps in its
            memory is copied.
        name: Name of the argument, for the error.
        numpy: Whether it is an array of NumPy, whose exchange takes less time.

    Raises:
        TypeError: The tensor is not dense, has no memory, or has a type that NumPy
            lacks.
        OutOfMemoryError: PyTorch has no memory for a copy.
        JaxRuntimeError: JAX has none.
    """
    if not isinstance(leaf, torch.Tensor):
        return leaf
    try:
        if numpy:
            return leaf.detach().numpy()
        return jax.dlpack.from_dlpack(leaf.detach().contiguous())
    except (torch.OutOfMemoryError, jax.errors.JaxRuntimeError):
        raise
    except (BufferError, RuntimeError, TypeError) as error:
        wrong = Fact(f"a {leaf.layout} tensor of {leaf.dtype}: {error}")
        allowed = "a dense tensor of float32 or float64, outside of torch.func"
        raise TypeError(message(name, wrong, allowed)) from error


def is_tracked(tree: PyTree) -> bool:
    """Returns whether a tensor in a pytree requires a gradient."""
    return any(
        leaf.requires_grad
        for leaf in jax.tree.leaves(tree)
        if isinstance(leaf, torch.Tensor)
    )
