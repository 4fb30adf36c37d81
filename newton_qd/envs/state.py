"""The state that ``reset`` and ``step`` return, and functions of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from newton_qd.checks import Fact, message
from newton_qd.errors import FaultError
from newton_qd.types import Info, Metrics, Observation, PyTree, StateLike

Tree = TypeVar("Tree")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class State:
    """The result of ``reset`` and ``step``; a pytree with constant shapes.

    The first axis of every leaf of a batched state is the batch axis.

    Attributes:
        pipeline_state: State of the simulation: a ``PhysicsState``.
        obs: (no,) observation.
        reward: () reward of the step that led here; 0 after a reset, except in mazes
            and with ``OffsetRewardWrapper``.
        done: () 1 if the episode has ended, else 0.
        metrics: Terms of the reward and other () quantities by name, 0 after a reset.
        info: Data of the wrappers; ``newton_qd.types.INFO_KEYS`` lists the keys.
    """

    pipeline_state: Any
    obs: Observation
    reward: jax.Array
    done: jax.Array
    metrics: Metrics
    info: Info
    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Raises an error that names the wrapper for views of brax v1.

            Raises:
                AttributeError: Always. Python calls this for missing attributes only.
            """
            raise AttributeError(no_brax_view(self, name, ("qp", "system")))

    def replace(self, **changes: object) -> State:
        """Returns a copy with some fields replaced."""
        return dataclasses.replace(self, **changes)


def no_brax_view(thing: object, name: str, views: tuple[str, ...]) -> str:
    """Returns the message for an attribute that is missing.

    Args:
        thing: Object that lacks the attribute.
        name: Name of the attribute.
        views: Attributes that exist for code written for brax v1 only.
    """
    if name in views:
        given = Fact(f"{type(thing).__name__} without bodies as brax v1 shows them")
        allowed = "simulated robots, with newton_qd.create(..., brax_views=True)"
        return message(name, given, allowed)
    return f"{type(thing).__name__!r} object has no attribute {name!r}"


def select(condition: jax.Array, chosen: Tree, other: Tree) -> Tree:
    """Chooses between two pytrees, world by world.

    Args:
        condition: Booleans; their axes are the first axes of every leaf.
        chosen: Values where ``condition`` is true.
        other: Values where ``condition`` is false.
    """

    def leaf(a: jax.Array, b: jax.Array) -> jax.Array:
        axes = condition.shape + (1,) * (jnp.ndim(b) - condition.ndim)
        return jnp.where(condition.reshape(axes), a, b)

    return jax.tree.map(leaf, chosen, other)


def per_world(read: Callable[[PyTree], Tree], state: State) -> Tree:
    """Applies a function to the simulation state of every world.

    Args:
        read: Function of the ``pipeline_state`` of one world.
        state: State of one world or of any batch.

    Returns:
        The results of ``read``, with the batch axes in front.
    """
    for _ in range(jnp.ndim(state.done)):
        read = jax.vmap(read)
    return read(state.pipeline_state)


def at_fault(state: StateLike) -> jax.Array:
    """Returns whether the world of a state has a fault, ()."""
    if "fault" in getattr(state, "info", {}):
        return state.info["fault"] != 0
    return jnp.zeros((), bool)


def check(state: State) -> None:
    """Raises an error if a world has a fault; call it outside ``jax.jit``.

    The physics freezes a world with a fault. It does not freeze a world for a reward,
    an observation or a state descriptor that is not finite. The error names these too.

    Args:
        state: State of one world or of any batch.

    Raises:
        FaultError: A world has a fault, a value of its state is not finite, or ``done``
            is neither 0 nor 1. The error names the worlds, and their steps if ``info``
            has them.
        TypeError: ``state`` is traced, or is no state.
        ValueError: ``state`` does not say whether it has a fault.
    """
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(state)):
        allowed = (
            "the concrete state that a jitted function has returned (inside jit, read "
            "info['fault'])"
        )
        raise TypeError(message("state", Fact("traced values"), allowed))
    allowed = "a State that reset or step returned"
    if not isinstance(getattr(state, "info", None), Mapping):
        raise TypeError(message("state", state, allowed))
    info: Mapping[str, Any] = state.info
    if "fault" not in info:
        raise ValueError(message("state", Fact("info without 'fault'"), allowed))
    faulty = np.asarray(info["fault"]) != 0
    steps = np.asarray(info["steps"]) if "steps" in info else None
    found = []
    if faulty.any():
        found.append(
            f"at fault: {_named(faulty, steps)}; frozen there with reward 0 and done 1 "
            "(an action or a state that is not finite, or a step that diverged)"
        )
    parts = {
        "state of the physics": state.pipeline_state,
        "reward": state.reward,
        "obs": state.obs,
        "state descriptor": info.get("state_descriptor"),
    }
    for name, part in parts.items():
        wrong = _not_finite(part, faulty.shape) & ~faulty
        if wrong.any():
            found.append(
                f"{name} not finite: {_named(wrong, steps)}; no fault, so not frozen"
            )
    ended = np.asarray(state.done)
    wrong = (ended != 0) & (ended != 1)
    if wrong.any():
        found.append(f"done neither 0 nor 1: {_named(wrong, steps)}")
    if found:
        raise FaultError(". ".join(found))


def _not_finite(part: Any, worlds: tuple[int, ...]) -> np.ndarray:
    """Returns which worlds have a value that is not finite, of the shape ``worlds``."""
    found = np.zeros(worlds, bool)
    for leaf in jax.tree.leaves(part):
        finite = np.isfinite(np.asarray(leaf))
        found = found | ~finite.all(axis=tuple(range(len(worlds), finite.ndim)))
    return found


def _named(chosen: np.ndarray, steps: np.ndarray | None) -> str:
    """Returns the text of the chosen worlds, at most 8 of them by name."""
    worlds = [tuple(int(i) for i in world) for world in np.argwhere(chosen)]
    named = []
    for world in worlds[:8]:
        index = world[0] if len(world) == 1 else world
        at = "" if steps is None else f" at step {int(steps[world])}"
        named.append(f"world {index}{at}" if world else f"the world{at}")
    more = f" and {len(worlds) - 8} more" if len(worlds) > 8 else ""
    return f"{', '.join(named)}{more}"
