"""The way of a gradient back from a control step to the one before it."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks
from newton_qd.types import PyTree

Tree = TypeVar("Tree")
Carry = TypeVar("Carry")
_LARGE = 2.0**64  # numbers above it are shrunk by it before they are clipped


@dataclasses.dataclass(frozen=True, kw_only=True)
class GradientOptions:
    """Windows, clipping, discounting and memory of the gradient of an episode.

    The value of the episode never changes. Windows, clipping and discounting act on the
    adjoint of the state between two control steps: first clip, then discount. Without
    them the gradient is exact. With them it is biased, but it stays bounded where the
    exact gradient would grow without limit.

    Attributes:
        window: Control steps after which the gradient is cut. A reward then has a
            gradient for actions of its own window only (Xu et al. 2022, "Accelerated
            policy learning with parallel differentiable simulation"). Windows begin at
            multiples of this number. ``None``: one window.
        clip: Largest Euclidean norm of the adjoint, over all floating-point numbers of
            the state of one world. A longer adjoint is scaled to it. ``None``: no
            limit.
        discount: Factor of the adjoint for each control step on the way back [-].
        checkpoint_every: Control steps between the states that are stored for the way
            back. The steps between are computed again. With 1, each control step stores
            one state. The square root of the episode's length needs the least memory.
            ``None``: all intermediate values of environment and policy are stored, and
            only the physics is computed again. This is the fastest way.

    Raises:
        TypeError: ``clip`` or ``discount`` is not a number.
        ValueError: A value is out of its range, or a number of steps is not an integer.
    """

    window: int | None = None
    clip: float | None = None
    discount: float = 1.0
    checkpoint_every: int | None = 1

    def __post_init__(self) -> None:
        """Checks every value."""
        for name in ("window", "checkpoint_every"):
            checks.integer(name, getattr(self, name), most=None, optional=True)
        checks.number("clip", self.clip, above=0, optional=True)
        checks.number("discount", self.discount, least=0, most=1)

    @property
    def exact(self) -> bool:
        """Whether the gradient is exact."""
        return self.window is None and self.clip is None and self.discount == 1

    def factors(self, steps: int) -> np.ndarray:
        """Returns the factor of the adjoint of the state before each step, (steps,)."""
        factors = np.full(steps, self.discount)
        if self.window is not None:
            factors[:: self.window] = 0.0
        factors[0] = 1.0  # no step is before the first state
        return factors


EXACT = GradientOptions()
"""The exact gradient; each control step stores one state."""


def passed_back(tree: Tree, factor: jax.Array, clip: float | None) -> Tree:
    """Returns a pytree unchanged, but changes the gradient on its way back.

    Args:
        tree: Pytree; leaves that are not floating-point have no gradient.
        factor: () factor of the gradient. With 0 the result is exactly 0, even if the
            gradient is not finite.
        clip: Largest norm of the gradient before the factor; ``None``: no limit.
    """
    leaves, structure = jax.tree.flatten(tree)
    real = [jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves]
    passed = iter(
        _identity(clip, [x for x, yes in zip(leaves, real, strict=True) if yes], factor)
    )
    leaves = [next(passed) if yes else x for x, yes in zip(leaves, real, strict=True)]
    return jax.tree.unflatten(structure, leaves)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _identity(
    clip: float | None, leaves: list[jax.Array], factor: jax.Array
) -> list[jax.Array]:
    del clip, factor
    return leaves


def _forward(
    clip: float | None, leaves: list[jax.Array], factor: jax.Array
) -> tuple[list[jax.Array], jax.Array]:
    del clip
    return leaves, factor


def _backward(
    clip: float | None, factor: jax.Array, adjoint: list[jax.Array]
) -> tuple[list[jax.Array], jax.Array]:
    scale = factor
    if clip is not None:
        # a power of two changes no digit; clip / norm would be too small for the dtype
        shrink = jnp.where(tree_largest(adjoint) > _LARGE, 1 / _LARGE, 1)
        small = [x * shrink.astype(x.dtype) for x in adjoint]
        norm = tree_norm(small)
        # no division without clipping; an adjoint that is not finite stays like this
        longer = norm > clip * shrink
        scale = scale * jnp.where(longer, clip / jnp.where(longer, norm, 1), 1)
        pairs = zip(small, adjoint, strict=True)
        adjoint = [jnp.where(longer, shrunk, x) for shrunk, x in pairs]
    cut = factor == 0
    changed = [jnp.where(cut, 0, x * scale.astype(x.dtype)) for x in adjoint]
    return changed, jnp.zeros_like(factor)


_identity.defvjp(_forward, _backward)


def scan_keeping(
    body: Callable[[Carry, PyTree], tuple[Carry, PyTree]],
    carry: Carry,
    rows: PyTree,
    steps: int,
    every: int | None,
) -> tuple[Carry, PyTree]:
    """Runs ``jax.lax.scan``, but stores only some carries for its gradient.

    Args:
        body: Maps a carry and a row to the next carry and to a reading.
        carry: The first carry.
        rows: Leaves (steps, ...).
        steps: Number of steps.
        every: Steps between stored carries. The steps between are computed again.
            ``None``: all intermediate values are stored.

    Returns:
        The last carry, and the readings, leaves (steps, ...).
    """
    if every is None:
        return jax.lax.scan(body, carry, rows, length=steps)
    if every == 1:
        body = jax.checkpoint(body, prevent_cse=False)
        return jax.lax.scan(body, carry, rows, length=steps)
    every = min(every, steps)
    segments = steps // every
    cut = segments * every

    def segment(
        carry: Carry, rows: PyTree, length: int = every
    ) -> tuple[Carry, PyTree]:
        return jax.lax.scan(body, carry, rows, length=length)

    heads = jax.tree.map(lambda x: x[:cut].reshape(segments, every, *x.shape[1:]), rows)
    kept = jax.checkpoint(segment, prevent_cse=False)
    carry, readings = jax.lax.scan(kept, carry, heads, length=segments)
    readings = jax.tree.map(lambda x: x.reshape(cut, *x.shape[2:]), readings)
    if cut == steps:
        return carry, readings
    tail = jax.tree.map(lambda x: x[cut:], rows)
    kept = jax.checkpoint(functools.partial(segment, length=steps - cut))
    carry, last = kept(carry, tail)
    return carry, jax.tree.map(lambda *x: jnp.concatenate(x), readings, last)


def tree_norm(tree: PyTree) -> jax.Array:
    """Returns the Euclidean norm () over all leaves; for use without gradient.

    Args:
        tree: Pytree of floating-point arrays.
    """
    # scaled first: squares of numbers above 1e19 are not finite in single precision
    largest = tree_largest(tree)
    unit = divisor(jnp.where(jnp.isfinite(largest), largest, 1))
    squares = [jnp.sum(jnp.square(x / unit)) for x in jax.tree.leaves(tree)]
    return unit * jnp.sqrt(functools.reduce(jnp.add, squares))


def tree_largest(tree: PyTree) -> jax.Array:
    """Returns the largest magnitude () over all leaves; for use without gradient.

    Args:
        tree: Pytree of floating-point arrays.
    """
    leaves = [jnp.max(jnp.abs(x), initial=0) for x in jax.tree.leaves(tree)]
    return functools.reduce(jnp.maximum, leaves)


def divisor(size: jax.Array) -> jax.Array:
    """Returns a number () to divide by numbers up to a size () with; 1 for size 0.

    It is the size, or a quarter of the largest number if the size is above. XLA
    multiplies by the reciprocal of a divisor, which would be too small for the dtype.
    """
    most = 1 / jnp.finfo(size.dtype).tiny
    return jnp.minimum(jnp.where(size == 0, 1, size), most)
