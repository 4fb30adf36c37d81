"""What environments refuse: the same words in every one of them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.envs.state import State
from newton_qd.physics.system import System
from newton_qd.types import Action, Params


def require_precision(dtype: np.dtype) -> None:
    """Raises where JAX would round a float64 environment to float32 without an error.

    Raises:
        ValueError: ``dtype`` is float64 and JAX x64 is off.
    """
    if dtype == np.float64 and not jax.config.read("jax_enable_x64"):
        raise ValueError(
            "dtype='float64': JAX x64 is off; allowed: 'float32', or "
            "jax.config.update('jax_enable_x64', True) before the environment"
        )


def require_actuators(system: System) -> None:
    """Raises for a robot without actuators, which no action could move.

    Raises:
        ValueError: The spec of the system's robot has no actuators.
    """
    if not system.nu:
        raise ValueError(
            f"robot {system.robot.name!r}, actuators=(): an environment has actions; "
            'allowed: at least one (joint, gear), such as (("hip", 30.0),)'
        )


def refuse_params(params: Params) -> None:
    """Raises where an environment without physical parameters is given some.

    Raises:
        ValueError: ``params`` is not ``None``.
    """
    if params is not None:
        raise ValueError(
            f"params: {type(params).__name__} given, and this environment has no "
            "physical parameters; allowed: None"
        )


def require_state(state: State, *keys: str) -> None:
    """Raises for what is no state, or one of an environment with fewer wrappers.

    Args:
        state: What a step was given.
        *keys: What the step reads of its ``info``.

    Raises:
        TypeError: It is no ``State``.
        ValueError: Its ``info`` lacks a key.
    """
    if not isinstance(state, State):
        raise TypeError(
            f"state: type {type(state).__name__} given; allowed: a State that reset or "
            "step returned"
        )
    for key in keys:
        if key not in state.info:
            raise ValueError(
                f"state: info has no {key!r}; allowed: a state that reset or step of "
                "this environment returned, wrappers included"
            )


def checked_action(action: Action, size: int, dtype: np.dtype) -> Action:
    """Returns the action, strongly typed, or raises what is wrong with it.

    Args:
        action: What a step was given.
        size: Length that is allowed.
        dtype: Type that is allowed; weakly typed numbers are converted to it.

    Raises:
        TypeError: It is no array, or of another type.
        ValueError: It has another shape.
    """
    expected = f"allowed: an array of shape {(size,)}, {dtype}"
    if not isinstance(action, (jax.Array, np.ndarray)):
        raise TypeError(f"action: type {type(action).__name__} given; {expected}")
    values = jnp.asarray(action)
    weak = jnp.issubdtype(values.dtype, jnp.floating) and values.weak_type
    if values.dtype != dtype and not weak:
        raise TypeError(f"action: dtype {values.dtype} given; {expected}")
    if values.shape != (size,):
        raise ValueError(
            f"action: shape {values.shape} given; {expected} (for a batch, use "
            "jax.vmap or create(..., batch_size=...))"
        )
    return values.astype(dtype)


def checked_layout(env: str, blocks: object) -> tuple[tuple[str, int], ...]:
    """Returns name and size of each block of an observation, or raises what is wrong.

    Args:
        env: Name of the class that observes.
        blocks: What its ``observe`` returned.

    Raises:
        TypeError: They are no dictionary with at least one block.
        ValueError: A block has not one axis.
    """
    if not isinstance(blocks, dict) or not blocks:
        raise TypeError(
            f"{env}.observe: returned {blocks!r}; allowed: a dictionary of arrays (n,)"
        )
    for name, block in blocks.items():
        if jnp.ndim(block) != 1:
            raise ValueError(
                f"{env}.observe: {name!r} has shape {jnp.shape(block)}; allowed: (n,), "
                "such as state.q[2:3] for one number"
            )
    return tuple((name, block.shape[0]) for name, block in blocks.items())


def checked_outcome(env: str, found: object) -> tuple[str, ...]:
    """Returns the names of the metrics, or raises what is wrong with an outcome.

    Args:
        env: Name of the class that rewards.
        found: Shapes of what its ``outcome`` returned.

    Raises:
        TypeError: It is not a tuple of reward, done and metrics.
        ValueError: A number is not of shape ().
    """
    if (
        not isinstance(found, tuple)
        or len(found) != 3
        or not isinstance(found[2], dict)
    ):
        raise TypeError(
            f"{env}.outcome: returned {found!r}; allowed: reward, done and a "
            "dictionary of metrics"
        )
    reward, done, metrics = found
    for name, value in {"reward": reward, "done": done, **metrics}.items():
        if jnp.shape(value) != ():
            raise ValueError(
                f"{env}.outcome: {name!r} has shape {jnp.shape(value)}; allowed: ()"
            )
    return tuple(metrics)
