"""The text of an environment: its name, sizes, wrappers, options and descriptor."""

from __future__ import annotations

from typing import Any

from newton_qd.checks import shown
from newton_qd.robots import RobotSpec
from newton_qd.scenes import Scene

REGISTERED = "_registered"
"""Attribute with the name that ``create`` was called with."""

OPTIONS = "_options"
"""Attribute with the keyword arguments of the constructor."""

EFFECTIVE = "_effective"
"""Attribute of wrappers that move inside others: whether this one acts by itself."""


def described(env: Any) -> str:
    """Returns the text of an environment, for ``repr``."""
    layers = [env]
    while "env" in vars(layers[-1]):
        layers.append(vars(layers[-1])["env"])
    names = [vars(layer)[REGISTERED] for layer in layers if REGISTERED in vars(layer)]
    name = names[0] if names else env.name
    sizes = [f"observation {env.observation_size}", f"action {env.action_size}"]
    if hasattr(env, "state_descriptor_name"):
        kind, length = env.state_descriptor_name, env.state_descriptor_length
        sizes.append(f"descriptor {kind} {length}")
    if hasattr(env, "batch_size"):
        sizes.append(f"batch {env.batch_size}")
    sizes.append(f"{env.dt:g} s")
    # a wrapper that moved inside others is shown there, not where it was applied
    acting = [layer for layer in layers if vars(layer).get(EFFECTIVE, True)]
    parts = ", ".join(_layer(layer) for layer in reversed(acting))
    return f"<{name}: {', '.join(sizes)}; {parts}>"


def component_names(env: Any, length: int) -> tuple[str, ...]:
    """Returns names of the components of the state descriptor, with their units.

    Args:
        env: Environment; it may have no state descriptor.
        length: Number of components.
    """
    own = getattr(env, "descriptor_labels", ())
    if len(own) == length > 0:
        return tuple(own)
    name = getattr(env, "state_descriptor_name", "descriptor")
    robot = getattr(env.unwrapped, "robot", None)
    if name == "feet_contact" and robot is not None and length == len(robot.feet):
        return tuple(f"{foot} contact" for foot in robot.feet)
    if name == "xy_position" and length == 2:
        return ("x", "y") if robot is None else ("x [m]", "y [m]")
    return tuple(f"{name} {index + 1}" for index in range(length))


def _layer(layer: Any) -> str:
    """Returns the class of an environment or of a wrapper, with its options."""
    own = vars(layer)
    if "env" in own:
        options = {k: v for k, v in own.items() if k != "env" and k[0] != "_"}
    else:
        options = own.get(OPTIONS, {})
    texts = [f"{name}={_value(value)}" for name, value in options.items()]
    return (
        f"{type(layer).__name__}({', '.join(texts)})" if texts else type(layer).__name__
    )


def _value(value: object) -> str:
    if isinstance(value, RobotSpec | Scene):
        return value.name
    return shown(value)
