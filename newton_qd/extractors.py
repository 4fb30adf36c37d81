"""Descriptors of whole episodes, computed from batches of transitions."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable
from typing import Protocol, Self

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.checks import Fact, listed, message
from newton_qd.types import (
    Descriptor,
    DescriptorExtractor,
    Mask,
    Observation,
    PyTree,
    StateDescriptors,
)


@dataclasses.dataclass(frozen=True)
class Trajectories:
    """The part of the transitions that descriptor extractors read.

    Attributes:
        state_desc: (n, t, nd) state descriptors before each step.
    """

    state_desc: jax.Array


def folded_sum(values: jax.Array, axis: int) -> jax.Array:
    """Sums by halving, in an order that does not depend on the other axes.

    The order of ``jnp.sum`` may depend on the batch size. This sum is bitwise the same
    for a batch of 1 and for the same row of a larger batch.

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


def get_final_xy_position(data: StateDescriptors, mask: Mask) -> Descriptor:
    """Returns the position before the last valid step of each episode.

    Args:
        data: Transitions with ``state_desc`` (n, t, nd), as QDax's ``QDTransition``:
            state descriptors before each step.
        mask: (n, t) 1 where a step comes after the end of the episode, else 0.

    Returns:
        (n, nd) last valid state descriptors.

    Raises:
        ValueError: ``mask`` has another shape than the steps of ``data``.
    """
    _require_steps(data, mask)
    last = jnp.sum(mask == 0, axis=1, dtype=jnp.int32) - 1
    return jax.vmap(lambda rows, index: rows[index])(data.state_desc, last)


def get_feet_contact_proportion(data: StateDescriptors, mask: Mask) -> Descriptor:
    """Returns the share of the valid steps in which each foot touched the ground.

    Args:
        data: Transitions with ``state_desc`` (n, t, nd), as QDax's ``QDTransition``:
            state descriptors before each step.
        mask: (n, t) 1 where a step comes after the end of the episode, else 0.

    Returns:
        (n, nd) proportions [-].

    Raises:
        ValueError: ``mask`` has another shape than the steps of ``data``.
    """
    _require_steps(data, mask)
    dtype = data.state_desc.dtype
    if not jnp.issubdtype(dtype, jnp.floating):  # a sum of flags would not fit
        dtype = jnp.promote_types(dtype, jnp.float32)
    valid = (1.0 - mask)[..., None].astype(dtype)
    # If all components had one number of steps, XLA would multiply by its reciprocal in
    # some batches, and 41 * (1 / 41) is not 1.
    steps = folded_sum(jnp.broadcast_to(valid, data.state_desc.shape), 1)
    # after the end, a state descriptor may be anything, also nan; 0 times nan is nan
    counts = (valid > 0) | jnp.isfinite(data.state_desc)
    values = jnp.where(counts, data.state_desc, jnp.zeros_like(data.state_desc))
    return folded_sum(values * valid, 1) / jax.lax.optimization_barrier(steps)


def get_mean_state_descriptor(data: StateDescriptors, mask: Mask) -> Descriptor:
    """Returns the mean state descriptor over the valid steps of each episode.

    Args:
        data: Transitions with ``state_desc`` (n, t, nd).
        mask: (n, t) 1 where a step comes after the end of the episode, else 0.

    Returns:
        (n, nd) means.

    Raises:
        ValueError: ``mask`` has another shape than the steps of ``data``.
    """
    return get_feet_contact_proportion(data, mask)


def _require_steps(data: StateDescriptors, mask: Mask) -> None:
    """Checks that a mask has a number for each step; JAX would read another one.

    Raises:
        ValueError: It has not.
    """
    steps = jnp.shape(data.state_desc)[:-1]
    if jnp.shape(mask) != steps:
        given = Fact(f"shape {jnp.shape(mask)}")
        raise ValueError(message("mask", given, f"{steps}, as the state descriptors"))


_READS = {
    get_final_xy_position: "xy_position",
    get_feet_contact_proportion: "feet_contact",
}
"""Name of the state descriptor that an extractor of this module is for."""


def check_extractor(env: object, extractor: object) -> None:
    """Checks that an extractor of this module fits the environment's state descriptor.

    Extractors of others, and state descriptors of others, may be combined freely.

    Args:
        env: The environment.
        extractor: Computes descriptors of episodes; ``None``: nothing does.

    Raises:
        ValueError: It reads another state descriptor than the environment writes.
    """
    reads = _READS.get(extractor) if isinstance(extractor, Hashable) else None  # type: ignore[call-overload]
    writes = getattr(env, "state_descriptor_name", None)
    if reads is None or writes == reads or writes not in _READS.values():
        return
    fitting = [one.__name__ for one, name in _READS.items() if name == writes]
    why = f"which reads {reads}, and the environment writes {writes}"
    allowed = listed([*fitting, get_mean_state_descriptor.__name__, "your own"])
    given = Fact(getattr(extractor, "__name__", repr(extractor)))
    raise ValueError(message("descriptor_extractor", given, allowed, why=why))


def reads_last(extractor: DescriptorExtractor, steps: int, length: int) -> bool:
    """Returns whether the descriptor of an episode depends on its end alone.

    For an extractor of others, it is tried: the last step of a random episode changes,
    and then all steps but the last.

    Args:
        extractor: Computes descriptors of episodes.
        steps: Number of steps of an episode.
        length: Number of components of a state descriptor.
    """
    if any(extractor is one for one in (*_READS, get_mean_state_descriptor)):
        return extractor is get_final_xy_position
    with jax.ensure_compile_time_eval():
        one, two = jax.random.uniform(jax.random.key(0), (2, 1, steps, length))
        mask = jnp.zeros((1, steps), one.dtype)
        end = jnp.arange(steps)[:, None] == steps - 1
        first, other_end, other_begin = (
            np.asarray(extractor(Trajectories(values), mask))
            for values in (one, jnp.where(end, two, one), jnp.where(end, one, two))
        )
    return bool(np.any(first != other_end) and np.all(first == other_begin))


class Encoder(Protocol):
    """A model that gets its parameters as an argument, such as a module of Flax."""

    def encode(self, observations: jax.Array) -> jax.Array:
        """Returns the encoding of observations."""
        ...

    def apply(
        self, variables: PyTree, *args: jax.Array, method: Callable[..., PyTree]
    ) -> jax.Array:
        """Calls a method of the model with given parameters."""
        ...


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class AuroraExtraInfo:
    """Data of AURORA beside a repertoire; a pytree.

    Attributes:
        model_params: Parameters of the model that reduces observations.
    """

    model_params: PyTree

    def replace(self, **changes: object) -> Self:
        """Returns a copy with some fields replaced."""
        return dataclasses.replace(self, **changes)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class AuroraExtraInfoNormalization(AuroraExtraInfo):
    """Data of AURORA, with the normalization of observations.

    Attributes:
        model_params: Parameters of the model that reduces observations.
        mean_observations: Mean; its shape broadcasts to that of the observations.
        std_observations: Standard deviation; its shape broadcasts too.
    """

    mean_observations: jax.Array
    std_observations: jax.Array

    @classmethod
    def create(
        cls,
        model_params: PyTree,
        mean_observations: jax.Array,
        std_observations: jax.Array,
    ) -> Self:
        """Returns an object with these three fields."""
        return cls(model_params, mean_observations, std_observations)


def get_aurora_encoding(
    observations: Observation,
    aurora_extra_info: AuroraExtraInfoNormalization,
    model: Encoder,
) -> Descriptor:
    """Returns descriptors that AURORA's model computes from observations.

    Args:
        observations: (n, t, no) observations, or another input of the model.
        aurora_extra_info: Parameters and normalization. A component with a standard
            deviation of 0 never changes. It is not divided: its value is its distance
            from the mean, which is 0.
        model: Flax module with a method ``encode``; static under ``jax.jit``.

    Returns:
        (n, nd) encodings, without axes of length 1.
    """
    deviation = aurora_extra_info.std_observations
    scale = jnp.where(deviation == 0, jnp.ones_like(deviation), deviation)
    normalized = (observations - aurora_extra_info.mean_observations) / scale
    variables = {"params": aurora_extra_info.model_params}
    return model.apply(variables, normalized, method=model.encode).squeeze()
