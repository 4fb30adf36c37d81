"""Doors to other libraries: each is one file around ``env.reset`` and ``env.step``.

- ``make_gymnasium(name)``: an environment of Gymnasium;
  ``make_gymnasium_vector(name, num_envs)``: many worlds, reset as they end
- ``newton_qd.adapters.torch.make_torch_step(env)``: reset and step for PyTorch, with
  gradients
- ``BraxEnv(name)``: an environment of brax; ``register_with_brax()`` adds all names to
  ``brax.envs.create``

Importing this package imports no other module of it. Each name is loaded when it is
first used, and needs its extra: ``gym``, ``torch`` or ``brax``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from newton_qd.lazy import loaded_name

if TYPE_CHECKING:
    from newton_qd.adapters.brax import BraxEnv, BraxSystem, register_with_brax
    from newton_qd.adapters.gymnasium import GymnasiumEnv, make_gymnasium
    from newton_qd.adapters.gymnasium_vector import (
        GymnasiumVectorEnv,
        make_gymnasium_vector,
    )

__all__ = [
    "BraxEnv",
    "BraxSystem",
    "GymnasiumEnv",
    "GymnasiumVectorEnv",
    "make_gymnasium",
    "make_gymnasium_vector",
    "register_with_brax",
]

_HOME = {
    "BraxEnv": ".brax",
    "BraxSystem": ".brax",
    "GymnasiumEnv": ".gymnasium",
    "GymnasiumVectorEnv": ".gymnasium_vector",
    "make_gymnasium": ".gymnasium",
    "make_gymnasium_vector": ".gymnasium_vector",
    "register_with_brax": ".brax",
}


def __getattr__(name: str) -> Any:
    """Loads a name of this package when it is first used."""
    return loaded_name(globals(), name, _HOME)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
