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

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.envs.base import Env
from newton_qd.envs.state import State
from newton_qd.errors import MissingExtra
from newton_qd.physics.parameters import FIELDS, PhysicsParams, check_bounds
from newton_qd.real_numbers import real_numbers
from newton_qd.types import Params, PyTree

try:
    import torch
    from torch.autograd.function import once_differentiable
except ModuleNotFoundError as error:
    raise MissingExtra("torch", "torch") from error


_FIELDS = tuple(field.name for field in dataclasses.fields(State))


class TorchState:
    """A :class:`newton_qd.State` whose leaves are tensors.

    It has the same attributes. Each becomes tensors when it is first read, so a step
    costs little. It is a pytree of tensors.

    Attributes:
        arrays: The same state with the arrays of JAX; ``None`` after ``replace``.
        tracked: Whether one of its tensors requires a gradient.
    """

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
        self.arrays = arrays
        self.tracked = bool(parts) and _tracked(parts)
        vars(self).update(parts)

    def __getattr__(self, name: str) -> Any:
        if name not in _FIELDS or self.arrays is None:
            kind = type(self).__name__
            raise AttributeError(f"{kind!r} object has no attribute {name!r}")
        value = jax.tree.map(to_torch, getattr(self.arrays, name))
        setattr(self, name, value)
        return value

    def __repr__(self) -> str:
        return f"<TorchState: observation {tuple(self.obs.shape)}>"

    @property
    def parts(self) -> dict[str, Any]:
        """All attributes by name, as tensors."""
        return {name: getattr(self, name) for name in _FIELDS}

    def replace(self, **changes: Any) -> TorchState:
        """Returns a copy with some attributes replaced.

        Raises:
            TypeError: A state has no such attribute.
        """
        for name, value in changes.items():
            if name not in _FIELDS:
                raise TypeError(
                    message(name, value, f"one of {checks.listed(_FIELDS)}")
                )
        return TorchState(None, {**self.parts, **changes})


jax.tree_util.register_pytree_node(
    TorchState,
    lambda state: ((state.parts,), None),
    lambda _, children: TorchState(None, *children),
)


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
        ``ValueError`` if the actions are on another device than the state, and all
        errors of ``env.step``.

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
    """
    if state.arrays is not None:
        return TorchState(state.arrays, {})
    return jax.tree.map(
        lambda leaf: leaf.detach() if isinstance(leaf, torch.Tensor) else leaf, state
    )


def to_torch(leaf: Any) -> Any:
    """Returns an array of JAX as a tensor that shares its memory.

    Args:
        leaf: An array. Random keys stay what they are: PyTorch has no such type.
    """
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return leaf
    return torch.from_dlpack(leaf)


def to_jax(leaf: Any) -> Any:
    """Returns a tensor as an array of JAX that shares its memory.

    Args:
        leaf: A tensor; other leaves stay what they are. A tensor with gaps in its
            memory is copied.
    """
    if not isinstance(leaf, torch.Tensor):
        return leaf
    return jax.dlpack.from_dlpack(leaf.detach().contiguous())


class _Door:
    """The compiled functions of an environment."""

    def __init__(self, env: Env) -> None:
        def run(parts: dict[str, Any], action: jax.Array, params: Params) -> State:
            return env.step(State(**parts), action, params)

        self._reset = jax.jit(env.reset)
        self._run = jax.jit(run)
        self.linearize = jax.jit(functools.partial(_linearized, run))
        self.pull = jax.jit(_pulled, static_argnums=(2, 3))

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
            TypeError: The state is not one of PyTorch, or the action is not a tensor.
            ValueError: The action is on another device than the state, or a physical
                parameter is out of bounds.
        """
        checks.instance("state", state, TorchState, "a state of reset or step")
        checks.instance("action", action, torch.Tensor, "a tensor of PyTorch")
        if action.device != state.obs.device:
            wrong = Fact(f"a tensor on {action.device}")
            raise ValueError(message("action", wrong, f"one on {state.obs.device}"))
        if state.arrays is None:
            parts = jax.tree.map(to_jax, state.parts)
        else:
            parts = {name: getattr(state.arrays, name) for name in _FIELDS}
        given = jax.tree.map(to_jax, params)
        self._check(given)
        tracked = action.requires_grad or state.tracked
        tracked = tracked or (params is not None and _tracked(params))
        if not tracked or not torch.is_grad_enabled():
            # the exchange of a NumPy array takes less time; it shares its memory too
            on_cpu = action.device.type == "cpu"
            array = action.detach().numpy() if on_cpu else to_jax(action)
            after = TorchState(self._run(parts, array, given), {})
            after.obs  # noqa: B018 - waits for the step: the inputs may change now
            return after
        found: list[State] = []
        inputs = parts, to_jax(action), given
        leaves = jax.tree.leaves((state.parts, action, params))
        results = _Step.apply(self, inputs, found, *leaves)
        structure = jax.tree.structure(_parts(found[0]))
        return TorchState(found[0], jax.tree.unflatten(structure, results))

    def _check(self, params: Params) -> None:
        """Checks the values of physical parameters, which are traced in the step.

        Raises:
            ValueError: A value is out of bounds.
        """
        if isinstance(params, PhysicsParams):
            for name in FIELDS:
                values = real_numbers(getattr(params, name))
                if values is not None:  # the step refuses what is no number
                    check_bounds(name, values)


def _parts(state: State) -> dict[str, Any]:
    """Returns the attributes of a state by name."""
    return {name: getattr(state, name) for name in _FIELDS}


def _tracked(tree: PyTree) -> bool:
    """Returns whether a tensor in a pytree requires a gradient."""
    return any(
        leaf.requires_grad
        for leaf in jax.tree.leaves(tree)
        if isinstance(leaf, torch.Tensor)
    )


def _moves(leaf: Any) -> bool:
    """Returns whether an array or tensor has a gradient."""
    if isinstance(leaf, torch.Tensor):
        return leaf.is_floating_point()
    return jnp.issubdtype(leaf.dtype, jnp.floating)


def _linearized(
    run: Callable[..., State], inputs: PyTree
) -> tuple[State, Callable[..., Any]]:
    """Returns the next state, and its gradient as a function that is a pytree."""
    leaves, structure = jax.tree.flatten(inputs)

    def step(moving: list[jax.Array]) -> tuple[list[jax.Array], State]:
        rest = iter(moving)
        merged = [next(rest) if _moves(leaf) else leaf for leaf in leaves]
        state = run(*jax.tree.unflatten(structure, merged))
        moved = [leaf for leaf in jax.tree.leaves(_parts(state)) if _moves(leaf)]
        return moved, state

    moving = [leaf for leaf in leaves if _moves(leaf)]
    _, pull, state = jax.vjp(step, moving, has_aux=True)
    return state, pull


def _pulled(
    pull: Callable[..., Any],
    slopes: list[jax.Array | None],
    shapes: tuple[jax.ShapeDtypeStruct, ...],
    wanted: tuple[bool, ...],
) -> list[jax.Array]:
    """Returns the gradients of the inputs that are wanted.

    Args:
        pull: What ``_linearized`` returned.
        slopes: Gradient of the loss with respect to each result; ``None``: zero.
        shapes: Shapes and types of the results.
        wanted: Which inputs are wanted.
    """
    pairs = zip(slopes, shapes, strict=True)
    given = [jnp.zeros(x.shape, x.dtype) if s is None else s for s, x in pairs]
    (found,) = pull(given)
    return [slope for slope, want in zip(found, wanted, strict=True) if want]


class _Step(torch.autograd.Function):
    """A step as an operation of PyTorch's graph."""

    @staticmethod
    def forward(
        ctx: Any, door: _Door, inputs: PyTree, found: list[State], *leaves: Any
    ) -> tuple[Any, ...]:
        """Runs the step; appends its result to ``found``."""
        state, ctx.pull = door.linearize(inputs)
        found.append(state)
        arrays = jax.tree.leaves(_parts(state))
        results = tuple(to_torch(array) for array in arrays)
        ctx.door, ctx.moving = door, tuple(map(_moves, leaves))
        ctx.shapes = tuple(
            jax.ShapeDtypeStruct(x.shape, x.dtype) if _moves(x) else None
            for x in arrays
        )
        ctx.set_materialize_grads(False)
        tensors = [x for x in results if isinstance(x, torch.Tensor)]
        ctx.mark_non_differentiable(*(x for x in tensors if not _moves(x)))
        # PyTorch then finds tensors that somebody changed before the way back
        given = [x for x in leaves if isinstance(x, torch.Tensor)]
        ctx.save_for_backward(*given, *tensors)
        return results

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Any) -> tuple[Any, ...]:
        """Returns the gradient of every leaf of the inputs that needs one.

        Raises:
            RuntimeError: A tensor was changed in place after the step.
        """
        _ = ctx.saved_tensors  # raises the error
        pairs = zip(slopes, ctx.shapes, strict=True)
        given = [to_jax(slope) for slope, shape in pairs if shape is not None]
        shapes = tuple(shape for shape in ctx.shapes if shape is not None)
        needed = ctx.needs_input_grad[3:]
        moving = zip(needed, ctx.moving, strict=True)
        wanted = tuple(need for need, moves in moving if moves)
        found = iter(ctx.door.pull(ctx.pull, given, shapes, wanted))
        return None, None, None, *(to_torch(next(found)) if x else None for x in needed)
