"""Differentiable-physics environments for Quality-Diversity in JAX.

The facade:

- ``create(name, ...)``, ``create_fn(name, ...)``: an environment by its name
- ``registered_envs()``, ``register(name, base, ...)``: the names; a new one
- ``Env``, ``State``: what ``create`` returns; what ``reset`` and ``step`` return
- ``check(state)``: raises ``FaultError`` where a world was frozen
- ``diagnose_gradients(env)``: over how many steps gradients can be used, and why;
  ``newton_qd.gradients`` has the gradients of whole episodes
- ``PhysicsParams``, ``randomize_params``: physical parameters of each world, which
  ``step`` takes and ``env.default_params`` has; drawn at random
- ``behavior_descriptor_extractor``, ``descriptor_extractor``, ``reward_offset``,
  ``original_reward_offset``: tables by environment name
- ``FEET_NAMES``, ``COG_NAMES``, ``FORWARD_REWARD_NAMES``: read-only tables of links
  and metrics by the name of the environment inside; ``register`` extends them

Importing the package imports none of its parts: each name is loaded when it is
first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from newton_qd.envs.base import Env
    from newton_qd.envs.randomization import randomize_params
    from newton_qd.envs.state import State, check
    from newton_qd.errors import FaultError, MissingExtra, UnknownEnvironment
    from newton_qd.gradients.doctor import diagnose_gradients
    from newton_qd.physics.parameters import PhysicsParams
    from newton_qd.registry import (
        COG_NAMES,
        FEET_NAMES,
        FORWARD_REWARD_NAMES,
        behavior_descriptor_extractor,
        create,
        create_fn,
        descriptor_extractor,
        original_reward_offset,
        register,
        registered_envs,
        reward_offset,
    )

__version__ = "0.1.0"

__all__ = [
    "COG_NAMES",
    "FEET_NAMES",
    "FORWARD_REWARD_NAMES",
    "Env",
    "FaultError",
    "MissingExtra",
    "PhysicsParams",
    "State",
    "UnknownEnvironment",
    "behavior_descriptor_extractor",
    "check",
    "create",
    "create_fn",
    "descriptor_extractor",
    "diagnose_gradients",
    "original_reward_offset",
    "randomize_params",
    "register",
    "registered_envs",
    "reward_offset",
]

_HOME = {
    "COG_NAMES": "newton_qd.registry",
    "FEET_NAMES": "newton_qd.registry",
    "FORWARD_REWARD_NAMES": "newton_qd.registry",
    "Env": "newton_qd.envs.base",
    "FaultError": "newton_qd.errors",
    "MissingExtra": "newton_qd.errors",
    "PhysicsParams": "newton_qd.physics.parameters",
    "State": "newton_qd.envs.state",
    "UnknownEnvironment": "newton_qd.errors",
    "behavior_descriptor_extractor": "newton_qd.registry",
    "check": "newton_qd.envs.state",
    "create": "newton_qd.registry",
    "create_fn": "newton_qd.registry",
    "descriptor_extractor": "newton_qd.registry",
    "diagnose_gradients": "newton_qd.gradients.doctor",
    "original_reward_offset": "newton_qd.registry",
    "randomize_params": "newton_qd.envs.randomization",
    "register": "newton_qd.registry",
    "registered_envs": "newton_qd.registry",
    "reward_offset": "newton_qd.registry",
}


def __getattr__(name: str) -> Any:
    """Loads a name of the facade when it is first used."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
