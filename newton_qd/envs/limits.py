"""Whether a number is within limits: 0 or 1, with or without a gradient."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks

_NARROWEST = 1e-6  # the slope of a narrower step is no number in float32


def within(
    value: jax.Array, limits: tuple[float, float], width: float | None = None
) -> jax.Array:
    r"""Returns 1 where a number is within limits, else 0, in its dtype.

    Without a width, the gradient is 0. With the width :math:`b`, the result stays 0 or
    1. Its gradient is the one of

    .. math:: \sigma((x - low) / b) \, \sigma((high - x) / b)

    with the logistic function :math:`\sigma` (Bengio et al. 2013, "Estimating or
    propagating gradients through stochastic neurons", section 5, straight-through). In
    the derivative of a factor, the other factor has its value, 0 or 1. So the slope at
    a limit is 1/(4 b).

    Args:
        value: () the number.
        limits: The lowest and the highest allowed value, in the unit of ``value``.
        width: Width of the gradient, in the unit of ``value``.

    Raises:
        TypeError: ``width`` is not a number.
        ValueError: ``width`` is not finite or below 1e-6.
    """
    low, high = (np.asarray(limit, value.dtype) for limit in limits)
    if width is None:
        return ((value >= low) & (value <= high)).astype(value.dtype)
    check_width("width", width)
    return _step(value - low, float(width)) * _step(high - value, float(width))


def survival(
    healthy: jax.Array, reward: float, *, ends: bool
) -> tuple[jax.Array, jax.Array]:
    """Returns the bonus () for being healthy, and done ().

    Args:
        healthy: () 1 if the robot is healthy, else 0, from :func:`within`.
        reward: Bonus per step [-].
        ends: Whether an unhealthy robot ends the episode; if not, it only loses the
            bonus.
    """
    if ends:
        return jnp.full_like(healthy, reward), 1 - healthy
    # only done has a gradient
    return reward * jax.lax.stop_gradient(healthy), jnp.zeros_like(healthy)


def check_width(name: str, width: object) -> None:
    """Checks the width of a gradient.

    Raises:
        TypeError: It is not a number.
        ValueError: It is not finite or below 1e-6.
    """
    checks.number(name, width, least=_NARROWEST)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _step(margin: jax.Array, width: float) -> jax.Array:
    """Returns 1 where the margin is at least 0, else 0."""
    del width
    return (margin >= 0).astype(margin.dtype)


@_step.defjvp
def _step_jvp(
    width: float, primals: tuple[jax.Array], tangents: tuple[jax.Array]
) -> tuple[jax.Array, jax.Array]:
    (margin,), (tangent,) = primals, tangents
    smooth = jax.nn.sigmoid(margin / width)
    return _step(margin, width), smooth * jax.nn.sigmoid(
        -margin / width
    ) / width * tangent
