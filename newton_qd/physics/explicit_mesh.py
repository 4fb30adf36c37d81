"""Batches that JAX splits over the devices of a mesh with explicit axes.

The axes of :func:`jax.make_mesh` are explicit by default. Then an array's type tells
how it is split, and JAX needs a rule for each operation:

- A call of a kernel has no such rule. Each device runs the worlds that it holds.
- Without explicit axes, XLA splits the batch, and with it calls of a CPU that are
  marked. It gives all worlds to every device for other calls.
- Under ``vmap`` the type of a constant does not tell how the worlds are split. JAX then
  refuses to join a constant with values of the worlds.
- Inside ``jax.shard_map`` the type of a constant does not vary over the devices. A loop
  that begins with one then has other types after a step.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jax.experimental.xla_metadata import set_xla_metadata
from jax.sharding import AxisType, NamedSharding, PartitionSpec

Tree = TypeVar("Tree")
Rows = Callable[..., jax.Array]
"""A function of arrays (..., size): a row for each world. It returns such an array."""


def row_like(rows: Sequence[jax.Array], size: int) -> jax.ShapeDtypeStruct:
    """Returns the type of a row (size,) that is computed from other rows.

    Inside ``jax.shard_map`` a type tells over which axes of the mesh its values vary.

    Args:
        rows: The rows that it is computed from.
        size: Its length.
    """
    kind = jax.ShapeDtypeStruct((size,), rows[0].dtype)
    named = _names_axes(rows[0])
    varying = frozenset().union(*map(_varying, rows))
    if not varying:
        return kind
    whole = NamedSharding(jax.sharding.get_abstract_mesh(), PartitionSpec())
    sharding: Any = jax.sharding
    if named:
        axes = sharding.ManualAxisType(varying=varying)
        return kind.update(manual_axis_type=axes, sharding=whole)
    return kind.update(vma=varying, sharding=whole)


def _names_axes(row: jax.Array) -> bool:
    """Returns whether a type has an object for its axes, as since JAX 0.10."""
    return hasattr(jax.typeof(row), "manual_axis_type")


def _varying(row: jax.Array) -> frozenset[Any]:
    """Returns the axes of the mesh over which a row varies inside ``jax.shard_map``."""
    kind: Any = jax.typeof(row)
    return kind.manual_axis_type.varying if _names_axes(row) else kind.vma


def split_row(row: jax.Array, offsets: list[int]) -> list[jax.Array]:
    """Splits a row (size,) as ``jnp.split`` does.

    Before JAX 0.9, the gradient of ``jnp.split`` inside ``jax.shard_map`` is an error
    if a part has no gradient.

    Args:
        row: The row.
        offsets: Where each part but the first begins.
    """
    if jax.__version_info__ >= (0, 9) or not _varying(row):
        return jnp.split(row, offsets)
    ends = [0, *offsets, row.size]
    return [row[begin:end] for begin, end in itertools.pairwise(ends)]


def rows_of(array: jax.Array, rows: np.ndarray, columns: slice) -> jax.Array:
    """Returns ``array[rows, columns]``.

    Since JAX 0.11, the gradient of this index needs a rule on a mesh with explicit
    axes. Parts that are joined need none.

    Args:
        array: (n, m) array of one world.
        rows: (k,) numbers of the rows, each at most once.
        columns: The columns.
    """
    if not _on_explicit_mesh(array):
        return array[rows, columns]
    return jnp.concatenate([array[row : row + 1, columns] for row in rows.tolist()])


def over_devices(
    call: Callable[..., tuple[jax.Array, ...]],
) -> Callable[..., tuple[jax.Array, ...]]:
    """Returns a function of one world's rows that takes split arrays under ``vmap``.

    Args:
        call: A :class:`~newton_qd.physics.row_calls.RowCall`. Under ``vmap`` the worlds
            share one launch. It calls an FFI target that is registered as partitionable
            along a batch: on a mesh with automatic axes, XLA itself splits the call.
    """

    @functools.partial(jax.jit, static_argnames="output_dims", inline=True)
    def run(*rows: jax.Array, output_dims: int) -> tuple[jax.Array, ...]:
        # a loop over steps is traced with the types of one world
        return (split_as(rows, batched(output_dims)(*rows)),)

    @functools.cache
    def batched(output_dims: int) -> Callable[..., jax.Array]:
        return _with_batch_rule(lambda *rows: call(*rows, output_dims=output_dims)[0])

    return run


def _with_batch_rule(call: Rows) -> Rows:
    @custom_vmap
    def run(*rows: jax.Array) -> jax.Array:
        return _split(call, rows)

    @run.def_vmap
    def run_batch(
        size: int, batched: list[bool], *rows: jax.Array
    ) -> tuple[jax.Array, bool]:
        whole = [
            row if given else jnp.broadcast_to(row, (size, *row.shape))
            for row, given in zip(rows, batched, strict=True)
        ]
        return run(*whole), True

    return run


def _split(call: Rows, rows: tuple[jax.Array, ...]) -> jax.Array:
    """Calls a function of rows on arrays (..., size), on each device for its worlds."""
    for _ in range(rows[0].ndim - 1):
        call = jax.vmap(call)
    call = _marked(call, rows[0].ndim - 1)
    found = [sharding for row in rows if (sharding := _explicit(row)) is not None]
    if not found:
        return call(*rows)
    own = [jax.sharding.reshard(row, found[0]) for row in rows]
    mesh, worlds = found[0].mesh, found[0].spec
    return jax.shard_map(call, mesh=mesh, in_specs=worlds, out_specs=worlds)(*own)


def _marked(call: Rows, axes: int) -> Rows:
    """Returns a call that XLA may split along its first axes, which are worlds."""

    def marked(*rows: jax.Array) -> jax.Array:
        with set_xla_metadata(num_batch_dims=str(axes)):
            return call(*rows)

    return marked


def _explicit(row: jax.Array) -> NamedSharding | None:
    """Returns how the worlds of an array (..., size) are split; ``None``: not."""
    sharding = jax.typeof(row).sharding
    worlds = PartitionSpec(*sharding.spec[: row.ndim - 1])
    if all(axis is None for axis in worlds):
        return None
    return NamedSharding(sharding.mesh, worlds)


@contextlib.contextmanager
def mesh_of(values: Any) -> Iterator[None]:
    """Lets JAX split constants under ``vmap``, while a function is compiled.

    Nothing changes without a mesh with explicit axes, and inside ``jax.set_mesh``.

    Args:
        values: Pytree; some of its arrays may be split.
    """
    arrays = [x for x in jax.tree.leaves(values) if isinstance(x, jax.Array)]
    split = [array for array in arrays if _on_explicit_mesh(array)]
    if not split or not jax.sharding.get_abstract_mesh().empty:
        yield
        return
    with jax.sharding.use_abstract_mesh(jax.typeof(split[0]).sharding.mesh):
        yield


def split_as(likes: Sequence[jax.Array], values: Tree) -> Tree:
    """Returns values of one world, split over devices as other arrays of this world.

    Nothing changes without a mesh with explicit axes and outside of ``jax.shard_map``.
    With them, the values stay the same, bit by bit.

    Args:
        likes: Arrays of the world, or its random key.
        values: Pytree of numbers of the world.
    """
    values = varying_as(likes, values)
    likes = [like for like in likes if like.size and _on_explicit_mesh(like)]
    if not likes:
        return values

    def split(value: jax.Array) -> jax.Array:
        # The sum with -0 keeps the sign of a zero. The factor, 0 or 1, makes -0 depend
        # on the world, so that JAX does not see a constant.
        if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            return value
        zero = jnp.asarray(-0.0, value.dtype)
        for like in likes:
            same = _first(like) == _first(like)
            value = value + same.astype(value.dtype) * zero
        return value

    return jax.tree.map(split, values)


def varying_as(likes: Sequence[jax.Array], values: Tree) -> Tree:
    """Returns values whose types vary over the axes over which other arrays vary.

    Only inside ``jax.shard_map`` a type varies. A loop over steps needs the same types
    before and after a step.

    Args:
        likes: Arrays, such as those of the world, or random keys.
        values: Pytree of numbers and random keys.
    """
    varying = frozenset().union(*map(_varying, likes))
    if not varying:
        return values
    own: Any = jax.lax

    def vary(value: jax.Array) -> jax.Array:
        missing = tuple(varying - _varying(value))
        if not missing:
            return value
        if hasattr(own, "pcast"):
            return own.pcast(value, missing, to="varying")
        return own.pvary(value, missing)

    return jax.tree.map(vary, values)


def varying_alike(values: Tree) -> Tree:
    """Returns values that all vary over the axes over which any of them varies.

    Outside of ``jax.shard_map``, nothing changes.

    Args:
        values: Pytree of numbers and random keys.
    """
    return varying_as(jax.tree.leaves(values), values)


def rows_split_as(like: jax.Array, values: Tree) -> Tree:
    """Returns values of a batch, split over devices as another array of this batch.

    Args:
        like: (N, ...) the array.
        values: Pytree, leaves (N, ...). Without a mesh with explicit axes, it is
            returned as it is.
    """
    if not _on_explicit_mesh(like):
        return values
    sharding = jax.typeof(like).sharding
    rows = NamedSharding(sharding.mesh, PartitionSpec(sharding.spec[0]))
    return jax.tree.map(lambda value: jax.sharding.reshard(value, rows), values)


def _on_explicit_mesh(array: jax.Array) -> bool:
    return AxisType.Explicit in jax.typeof(array).sharding.mesh.axis_types


def _first(like: jax.Array) -> jax.Array:
    """Returns the first number () of an array or of a random key."""
    if jnp.issubdtype(like.dtype, jax.dtypes.prng_key):
        like = jax.random.key_data(like)
    return like.ravel()[0]
