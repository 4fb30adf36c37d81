"""Differentiable-physics environments for Quality-Diversity in JAX.

The facade:

- ``create(name, ...)``, ``create_fn(name, ...)``: build an environment by its name
- ``registered_envs()``, ``register(name, base, ...)``: list the names; add a name
- ``Env``, ``State``: result of ``create``; result of ``reset`` and ``step``
- ``check(state)``: raises ``FaultError`` if a world was frozen
- ``Episode(env, policy, ...)``: an episode and its gradients; more about gradients is
  in ``newton_qd.gradients``
- ``diagnose_gradients(env)``: the number of steps for which gradients are useful
- ``PhysicsParams``: physical parameters of each world, an argument of ``step``;
  ``env.default_params`` has the default values
- ``randomize_params``: physical parameters drawn at random
- ``NewtonQDSolver``: the same physics as a solver of Newton

``newton_qd.qd`` has Quality-Diversity with the environments. ``newton_qd.authoring``
has everything that you need for your own environment. ``newton_qd.tables`` has tables
by the name of an environment.

Importing the package imports no other module of it. Each name is loaded when it is
first used.
"""

from __future__ import annotations

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from newton_qd import authoring as authoring
    from newton_qd import gradients as gradients
    from newton_qd import tables as tables
    from newton_qd.envs.base import Env
    from newton_qd.envs.randomization import randomize_params
    from newton_qd.envs.state import State, check
    from newton_qd.errors import FaultError, MissingExtra, UnknownEnvironment
    from newton_qd.gradients.doctor import diagnose_gradients
    from newton_qd.gradients.episode import Episode
    from newton_qd.physics.parameters import PhysicsParams
    from newton_qd.physics.solver import NewtonQDSolver
    from newton_qd.registry import create, create_fn, register, registered_envs

__version__ = "0.2.0"

__all__ = [
    "Env",
    "Episode",
    "FaultError",
    "MissingExtra",
    "NewtonQDSolver",
    "PhysicsParams",
    "State",
    "UnknownEnvironment",
    "check",
    "create",
    "create_fn",
    "diagnose_gradients",
    "randomize_params",
    "register",
    "registered_envs",
]

_HOME = {
    "Env": "newton_qd.envs.base",
    "Episode": "newton_qd.gradients.episode",
    "FaultError": "newton_qd.errors",
    "MissingExtra": "newton_qd.errors",
    "NewtonQDSolver": "newton_qd.physics.solver",
    "PhysicsParams": "newton_qd.physics.parameters",
    "State": "newton_qd.envs.state",
    "UnknownEnvironment": "newton_qd.errors",
    "check": "newton_qd.envs.state",
    "create": "newton_qd.registry",
    "create_fn": "newton_qd.registry",
    "diagnose_gradients": "newton_qd.gradients.doctor",
    "randomize_params": "newton_qd.envs.randomization",
    "register": "newton_qd.registry",
    "registered_envs": "newton_qd.registry",
}

_MODULES = ("authoring", "gradients", "tables")
"""Modules that the facade loads as ``newton_qd.NAME``."""

_MOVED = {
    "COG_NAMES": "newton_qd.tables.COG_NAMES",
    "FEET_NAMES": "newton_qd.tables.FEET_NAMES",
    "FORWARD_REWARD_NAMES": "newton_qd.tables.FORWARD_REWARD_NAMES",
    "behavior_descriptor_extractor": "newton_qd.tables.behavior_descriptor_extractor",
    "descriptor_extractor": "newton_qd.tables.descriptor_extractor",
    "original_reward_offset": "newton_qd.tables.original_reward_offset",
    "reward_offset": "newton_qd.tables.reward_offset",
}


def __getattr__(name: str) -> Any:
    """Loads a name of the facade when it is first used.

    Raises:
        AttributeError: The facade does not have it.
    """
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    if name not in _HOME:
        from newton_qd.moved import moved_name

        path = f"{__name__}.{name}"
        if not name.startswith("_") and importlib.util.find_spec(path) is not None:
            raise AttributeError(f"{path} is loaded by itself: import {path}")
        return moved_name(__name__, name, _MOVED)
    from newton_qd.lazy import loaded_name

    return loaded_name(globals(), name, _HOME)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_MODULES})
