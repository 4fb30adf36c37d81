"""Domain randomization: physical parameters drawn at random for every world."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.envs.base import Env
from newton_qd.envs.inputs import require_key
from newton_qd.physics.parameters import FIELDS, PhysicsParams, check_bounds
from newton_qd.real_numbers import real_numbers
from newton_qd.types import RNGKey

Range: TypeAlias = tuple[ArrayLike, ArrayLike]
"""Lowest and highest value."""


def randomize_params(
    key: RNGKey,
    env: Env,
    worlds: int | None = None,
    *,
    gravity: Range | None = None,
    friction: Range | None = None,
    contact_stiffness_scale: Range | None = None,
    mass_scale: Range | None = None,
    inertia_scale: Range | None = None,
    damping_scale: Range | None = None,
    gear_scale: Range | None = None,
) -> PhysicsParams:
    """Draws physical parameters. Each entry is uniform and independent of the others.

    The parameters of a world depend on the key and on the index of the world, but not
    on the number of worlds.

    Args:
        key: One key.
        env: A simulated robot, with or without wrappers.
        worlds: Length of the batch axis; ``None``: the batch of ``env``, or no batch
            axis if ``env`` has no batch.
        gravity: Lowest and highest value: two numbers, or two arrays with the shape of
            the parameter of one world. ``None``: the value of the robot's files.
            :class:`~newton_qd.physics.parameters.PhysicsParams` explains each
            parameter.
        friction: Lowest and highest value, as for ``gravity``.
        contact_stiffness_scale: Lowest and highest value, as for ``gravity``.
        mass_scale: Lowest and highest value, as for ``gravity``.
        inertia_scale: Lowest and highest value, as for ``gravity``.
        damping_scale: Lowest and highest value, as for ``gravity``.
        gear_scale: Lowest and highest value, as for ``gravity``.

    Returns:
        Parameters for ``env.step``, or for its ``vmap`` if ``worlds`` is given.

    Raises:
        TypeError: ``env`` is not an environment, or ``key`` is not a key.
        ValueError: The environment has no physical parameters, ``worlds`` is not an
            integer above 0 or not that of ``env``, ``key`` is several keys, or a range
            is wrong.
    """
    require_key("key", key)
    default = _default(env, worlds)
    given = {
        "gravity": gravity,
        "friction": friction,
        "contact_stiffness_scale": contact_stiffness_scale,
        "mass_scale": mass_scale,
        "inertia_scale": inertia_scale,
        "damping_scale": damping_scale,
        "gear_scale": gear_scale,
    }
    bounds = {
        name: _bounds(name, limits, getattr(default, name))
        for name, limits in given.items()
        if limits is not None
    }
    batch = jnp.shape(env.default_params.gravity)
    if worlds is not None and batch not in ((), (worlds,)):
        allowed = f"{batch[0]}, as env has, or None"
        raise ValueError(message("worlds", worlds, allowed))
    batch = batch if worlds is None else (worlds,)
    if not batch:
        return _draw(key, default, bounds)
    keys = jax.random.split(key, batch)
    return jax.vmap(_draw, (0, None, None))(keys, default, bounds)


def _default(env: Env, worlds: int | None) -> PhysicsParams:
    """Returns the parameters of one world, with the values of the robot's files.

    Raises:
        TypeError: ``env`` is not an environment.
        ValueError: It has no physical parameters, or ``worlds`` is not an integer
            above 0.
    """
    checks.environment(env, needs="unwrapped")
    checks.environment(env, needs="default_params")
    default = env.unwrapped.default_params
    if not isinstance(default, PhysicsParams):
        given = Fact(f"{env.name}, which has no physical parameters")
        raise ValueError(message("env", given, "simulated robots"))
    checks.integer("worlds", worlds, optional=True)
    return default


def _bounds(name: str, limits: Range, default: jax.Array) -> tuple[np.ndarray, ...]:
    """Returns the two ends of a range, in the dtype of the parameter.

    Raises:
        ValueError: The range has the wrong shape, type or order.
    """
    allowed = "(low, high), numbers"
    if default.shape:
        allowed += f" or arrays of shape {default.shape}"
    refusal = message(name, limits, allowed)
    known = isinstance(limits, jax.Array) and not isinstance(limits, Tracer)
    try:
        # under ``jit``, the entries of an array of JAX would be traced
        pair = np.asarray(limits) if known else limits
        ends = [real_numbers(end) for end in pair]
        low, high = (
            np.broadcast_to(end.astype(default.dtype), default.shape)
            for end in ends
            if end is not None
        )
    except (TypeError, ValueError) as error:
        raise ValueError(refusal) from error
    if len(ends) != 2 or isinstance(limits, Mapping):  # whose keys would be the ends
        raise ValueError(refusal)
    check_bounds(name, np.stack([low, high]))
    if np.any(low > high):
        why = "where low is above high"
        raise ValueError(message(name, limits, allowed, why=why))
    return low, high


@jax.jit
def _draw(
    key: RNGKey, default: PhysicsParams, bounds: dict[str, tuple[np.ndarray, ...]]
) -> PhysicsParams:
    """Returns the parameters of one world."""
    drawn = {}
    for name, (low, high) in bounds.items():
        # one key for each field, so that a draw does not depend on the other ranges
        own = jax.random.fold_in(key, FIELDS.index(name))
        like = getattr(default, name)
        drawn[name] = jax.random.uniform(own, like.shape, like.dtype, low, high)
    return default.replace(**drawn)
