"""Leaves of the state of an emitter, in the memory of host and device."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.qd.run.checkpoint import CheckpointError
from newton_qd.types import PyTree


def leaf_to_host(leaf: Any) -> np.ndarray:
    """Copies a leaf to the host; a key becomes its integers."""
    if jnp.issubdtype(jnp.asarray(leaf).dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    return np.asarray(leaf)


def leaf_to_device(leaf: np.ndarray, like: Any) -> jax.Array:
    """Inverts ``leaf_to_host``."""
    if jnp.issubdtype(like.dtype, jax.dtypes.prng_key):
        impl = jax.random.key_impl(jnp.empty((), like.dtype))
        return jax.random.wrap_key_data(jnp.asarray(leaf), impl=impl)
    return jnp.asarray(leaf, like.dtype)


def tree_to_device(
    leaves: tuple[np.ndarray, ...], example: PyTree, algorithm: str
) -> PyTree:
    """Makes the state of an emitter from the leaves of a checkpoint.

    Args:
        leaves: The leaves.
        example: A state with the expected shapes.
        algorithm: Name of the algorithm, for the error.

    Raises:
        CheckpointError: The leaves do not fit this algorithm.
    """
    expected, structure = jax.tree.flatten(example)
    if len(leaves) != len(expected):
        raise CheckpointError(
            f"the checkpoint holds {len(leaves)} arrays of the algorithm "
            f"{algorithm!r}; this version of it has {len(expected)}"
        )
    restored = [
        leaf_to_device(x, like) for x, like in zip(leaves, expected, strict=True)
    ]
    for index, (x, like) in enumerate(zip(restored, expected, strict=True)):
        if x.shape != like.shape:
            raise CheckpointError(
                f"array {index} of the algorithm {algorithm!r} has shape {x.shape} "
                f"in the checkpoint, {like.shape} in this version"
            )
    return jax.tree.unflatten(structure, restored)
