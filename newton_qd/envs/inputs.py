"""Checks of inputs that all environments share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.envs.state import State
from newton_qd.physics.system import PhysicsState, System
from newton_qd.real_numbers import require_real
from newton_qd.types import Action, Params


def require_actuators(system: System) -> None:
    """Checks that a robot has actuators.

    Raises:
        ValueError: The spec of the system's robot has no actuators.
    """
    if not system.nu:
        name = f"robot {system.robot.name!r}, actuators"
        allowed = 'at least one (joint, gear), such as (("hip", 30.0),)'
        why = "and an environment has actions"
        raise ValueError(message(name, system.robot.actuators, allowed, why=why))


def refuse_params(params: Params) -> None:
    """Checks that ``params`` is ``None``, for environments without parameters.

    Raises:
        ValueError: ``params`` is not ``None``.
    """
    if params is not None:
        why = "and this environment has no physical parameters"
        raise ValueError(message("params", params, "None", why=why))


OWN_STATE = "a state that reset or step of this environment returned, wrappers included"


def require_key(name: str, key: Any, *, several: bool = False) -> None:
    """Checks that a value is a random key.

    Args:
        name: Name of the argument.
        key: Its value.
        several: Whether an array of keys is allowed too.

    Raises:
        TypeError: It is not a key.
        ValueError: It is an array of keys, or has the wrong shape.
    """
    allowed = "one key, such as jax.random.key(0)"
    if several:
        allowed += ", or an array of keys, such as jax.random.split(key, 8)"
    dtype: Any = key.dtype if checks.is_array(key) else None
    typed = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key)
    if not typed and dtype != np.uint32:  # keys of the old kind are numbers (2,)
        raise TypeError(message(name, key, allowed))
    if not several and len(key.shape) != (0 if typed else 1):
        allowed += " (for a batch, use jax.vmap or create(..., batch_size=...))"
        raise ValueError(message(name, key, allowed))
    if not typed and key.shape[-1:] not in ((2,), (4,)):
        raise ValueError(message(name, key, allowed))


def require_state(state: State, *keys: str) -> None:
    """Checks that a value is a state, and that its ``info`` has some keys.

    Args:
        state: Argument of a step.
        *keys: Keys of ``info`` that the step reads.

    Raises:
        TypeError: It is not a ``State``.
        ValueError: A key is missing.
    """
    checks.instance("state", state, State, "a State that reset or step returned")
    for key in keys:
        if not isinstance(state.info, Mapping) or key not in state.info:
            given = Fact(f"info without {key!r}")
            raise ValueError(message("state", given, OWN_STATE))


def require_robot_state(state: State, system: System, metrics: tuple[str, ...]) -> None:
    """Checks that a state is one of a simulated robot, and of the same kind.

    Args:
        state: Argument of a step.
        system: The robot.
        metrics: Names of the metrics of its environment.

    Raises:
        TypeError: It is not a ``State``.
        ValueError: It is a state of another environment.
    """
    require_state(state, "fault")
    found = state.pipeline_state
    allowed = f"{OWN_STATE} (the robot is {system.robot.name!r})"
    if not isinstance(found, PhysicsState):
        given = Fact(f"a pipeline_state of type {type(found).__name__}")
        raise ValueError(message("state", given, allowed))
    sizes = jnp.shape(found.q), jnp.shape(found.v)
    if sizes != ((system.nq,), (system.nv,)):
        given = Fact(f"coordinates and velocities of shape {sizes[0]} and {sizes[1]}")
        allowed += f" of shape {(system.nq,)} and {(system.nv,)} (for a batch, use "
        allowed += "jax.vmap or create(..., batch_size=...))"
        raise ValueError(message("state", given, allowed))
    missing = [name for name in metrics if name not in state.metrics]
    if missing and state.metrics:  # a user may drop all metrics
        given = Fact(f"metrics without {missing[0]!r}")
        raise ValueError(message("state", given, allowed))


def require_point_state(state: State, dtype: np.dtype) -> None:
    """Checks that a state is one of a point, whose observation is its position.

    Args:
        state: Argument of a step.
        dtype: Allowed dtype. Weakly typed numbers are converted to it.

    Raises:
        TypeError: It is not a ``State``, or has another precision.
        ValueError: It is a state of another environment.
    """
    require_state(state, "fault")
    if jnp.shape(state.obs) != (2,):
        given = Fact(f"obs of shape {jnp.shape(state.obs)}")
        raise ValueError(message("state", given, f"{OWN_STATE}, so obs of shape (2,)"))
    checks.array("state.obs", state.obs, (2,), dtype)


def checked_action(action: Action, size: int, dtype: np.dtype) -> Action:
    """Checks an action, and returns it strongly typed.

    Args:
        action: Argument of a step.
        size: Allowed length.
        dtype: Allowed dtype. Weakly typed numbers are converted to it.

    Raises:
        TypeError: It is not an array, or has the wrong dtype.
        ValueError: It has the wrong shape.
    """
    return checks.array("action", action, (size,), dtype)


def checked_layout(env: str, blocks: object) -> tuple[tuple[str, int], ...]:
    """Checks the result of ``observe``, and returns name and size of each block.

    Args:
        env: Name of the class with this ``observe``.
        blocks: Result of ``observe``.

    Raises:
        TypeError: It is not a dictionary with at least one block, or a block is not
            an array of real numbers.
        ValueError: A block does not have exactly one axis.
    """
    if not isinstance(blocks, dict) or not blocks:
        allowed = "a dictionary of arrays (n,)"
        raise TypeError(message(f"{env}.observe", blocks, allowed))
    for name, block in blocks.items():
        allowed = "shape (n,), such as state.q[2:3] for one number"
        if not checks.is_array(block):
            given = Fact(f"a {type(block).__name__}")
            allowed = f"an array of {allowed}"
            raise TypeError(message(f"{env}.observe: {name!r}", given, allowed))
        if len(block.shape) != 1:
            given = Fact(f"shape {block.shape}")
            raise ValueError(message(f"{env}.observe: {name!r}", given, allowed))
        require_real(f"{env}.observe: {name!r}", block)
    return tuple((name, block.shape[0]) for name, block in blocks.items())


def checked_outcome(env: str, found: object) -> tuple[str, ...]:
    """Checks the result of ``outcome``, and returns the names of the metrics.

    Args:
        env: Name of the class with this ``outcome``.
        found: Result of ``outcome``, while JAX traces it.

    Raises:
        TypeError: It is not a tuple of reward, done and metrics, one of these is not a
            real number, or the name of a metric is not text.
        ValueError: A number does not have the shape ().
    """
    if (
        not isinstance(found, tuple)
        or len(found) != 3
        or not isinstance(found[2], dict)
    ):
        allowed = "reward, done and a dictionary of metrics"
        raise TypeError(message(f"{env}.outcome", found, allowed))
    reward, done, metrics = found
    for name in metrics:
        checks.instance(f"{env}.outcome: the name of a metric", name, str, "text")
    for name, value in [("reward", reward), ("done", done), *metrics.items()]:
        require_real(f"{env}.outcome: {name!r}", value)
        if jnp.shape(value) != ():
            given = Fact(f"shape {jnp.shape(value)}")
            raise ValueError(message(f"{env}.outcome: {name!r}", given, "shape ()"))
    return tuple(metrics)


def require_vector(name: str, found: object, size: int, *, meaning: str) -> None:
    """Checks the result of ``control`` or ``reset_pose``.

    Args:
        name: Class and method.
        found: Shape of the result.
        size: Allowed length.
        meaning: What the result is, for the error.

    Raises:
        TypeError: It is not an array.
        ValueError: It has another shape.
    """
    allowed = f"{meaning}, shape {(size,)}"
    if not checks.is_array(found):
        given = Fact(f"a {type(found).__name__}")
        raise TypeError(message(name, given, allowed))
    require_real(name, found)
    if jnp.shape(found) != (size,):
        raise ValueError(message(name, Fact(f"shape {jnp.shape(found)}"), allowed))
