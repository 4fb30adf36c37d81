r"""Weights of a policy in terms of whitened observations.

A policy of the archive sees observations as they are. Their entries differ much in
size: an angle is below 3, an angular velocity may be 30. A step of Adam that is small
for one entry is then large for another. So an actor learns the weights :math:`w, b` of
its first layer for whitened observations,

.. math:: w^T \frac{o - \mu}{\sigma} + b = (w / \sigma)^T o + b - (w / \sigma)^T \mu.

The right side says which policy of the archive it is. It is the same function.
"""

from __future__ import annotations

import dataclasses
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.qd.scoring.rollout import Policy

Scale: TypeAlias = tuple[jax.Array, jax.Array]
"""Mean and standard deviation of observations, (no,) each."""


@dataclasses.dataclass(frozen=True, eq=False)
class Whitening:
    """Converts weights between plain and whitened observations.

    Attributes:
        kernel: (no, width) places of the first layer's weights in a vector of weights.
        bias: (width,) places of its bias. ``None`` for both: weights stay as they are.
    """

    kernel: np.ndarray | None = None
    bias: np.ndarray | None = None

    @classmethod
    def of(cls, policy: Policy) -> Whitening:
        """Returns the conversion for a policy.

        A network that is no perceptron has no first layer that is known. Its weights
        stay as they are.
        """
        with jax.ensure_compile_time_eval():
            places = policy.unravel(jnp.arange(policy.size, dtype=jnp.float32))
        params = places.get("params", {}) if isinstance(places, dict) else {}
        match params.get("Dense_0"):
            case {"kernel": kernel, "bias": bias}:
                return cls(*(np.asarray(x).astype(np.int32) for x in (kernel, bias)))
        return cls()

    def plain(self, weights: jax.Array, scale: Scale) -> jax.Array:
        """Returns the weights (..., size) of the same policy of plain observations.

        Args:
            weights: (..., size) weights for whitened observations.
            scale: Mean and deviation of observations; entries after ``no`` are not
                used.
        """
        if self.kernel is None or self.bias is None:
            return weights
        inputs = len(self.kernel)
        mean, deviation = (x[:inputs].astype(weights.dtype) for x in scale)
        kernel = weights[..., self.kernel] / deviation[:, None]
        bias = weights[..., self.bias] - mean @ kernel
        return weights.at[..., self.kernel].set(kernel).at[..., self.bias].set(bias)

    def whitened(self, weights: jax.Array, scale: Scale) -> jax.Array:
        """Returns weights (..., size) for whitened observations; undoes ``plain``."""
        if self.kernel is None or self.bias is None:
            return weights
        inputs = len(self.kernel)
        mean, deviation = (x[:inputs].astype(weights.dtype) for x in scale)
        kernel = weights[..., self.kernel]
        bias = weights[..., self.bias] + mean @ kernel
        kernel = kernel * deviation[:, None]
        return weights.at[..., self.kernel].set(kernel).at[..., self.bias].set(bias)
