"""Descriptors of whole episodes, read from batches of transitions."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from newton_qd.types import Descriptor, Mask


def folded_sum(values: jax.Array, axis: int) -> jax.Array:
    """Sums by halving, in an order that does not depend on the other axes.

    ``jnp.sum`` may add in another order when the batch has another size; this
    sum is bitwise the same for a batch of 1 and for the same row of a larger one.

    Args:
        values: Array of any shape.
        axis: Axis to sum over.

    Returns:
        The sum, without that axis.
    """
    rest = jnp.moveaxis(values, axis, 0)
    if rest.shape[0] == 0:
        return jnp.zeros(rest.shape[1:], rest.dtype)
    while rest.shape[0] > 1:
        half = rest.shape[0] // 2
        folded = rest[:half] + rest[half : 2 * half]
        rest = jnp.concatenate([folded, rest[2 * half :]])
    return rest[0]


def get_final_xy_position(data: Any, mask: Mask) -> Descriptor:
    """Position before the last valid step of each episode.

    Args:
        data: Transitions with ``state_desc`` (n, t, nd), as QDax's ``QDTransition``:
            state descriptors before each step.
        mask: (n, t) 1 where a step comes after the end of the episode, else 0.

    Returns:
        (n, nd) last valid state descriptors.
    """
    last = jnp.sum(mask == 0, axis=1, dtype=jnp.int32) - 1
    return jax.vmap(lambda rows, index: rows[index])(data.state_desc, last)


def get_feet_contact_proportion(data: Any, mask: Mask) -> Descriptor:
    """Proportion of the valid steps at which each foot touched the ground.

    Args:
        data: Transitions with ``state_desc`` (n, t, nd), as QDax's ``QDTransition``:
            state descriptors before each step.
        mask: (n, t) 1 where a step comes after the end of the episode, else 0.

    Returns:
        (n, nd) proportions [-].
    """
    valid = (1.0 - mask)[..., None].astype(data.state_desc.dtype)
    return folded_sum(data.state_desc * valid, 1) / folded_sum(valid, 1)
