"""The base class of wrappers. It changes nothing."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.envs.base import Env
from newton_qd.envs.env import raise_own_error
from newton_qd.envs.rollouts import RolloutOrder
from newton_qd.envs.state import State
from newton_qd.robots import Material, RobotSpec
from newton_qd.scenes import Scene
from newton_qd.types import Action, Params, RNGKey

Kind = TypeVar("Kind", bound="Wrapper")


def unsupported(env: Env, env_name: str, allowed: str) -> str:
    """Returns the error message of a wrapper that cannot wrap an environment.

    Args:
        env: The environment.
        env_name: Its name.
        allowed: Description of the environments that are allowed.
    """
    refusal = message("env", Fact(type(env.unwrapped).__name__), allowed)
    return f"This wrapper does not support {env_name} yet. {refusal}"


def outermost(env: Env, kind: type[Kind]) -> Kind | None:
    """Returns the outermost wrapper of a kind, ``env`` included; ``None`` without."""
    while isinstance(env, Wrapper):
        if isinstance(env, kind):
            return env
        env = env.env
    return None


def refuse_second(env: Env, kind: type[Wrapper], why: str) -> None:
    """Checks that an environment has no wrapper of a kind yet.

    Args:
        env: The environment.
        kind: The class.
        why: What it would do inside the new wrapper, for the error.

    Raises:
        ValueError: It has one.
    """
    if outermost(env, kind) is not None:
        given = Fact(f"an environment with {kind.__name__}")
        raise ValueError(message("env", given, "one without it", why=why))


class Wrapper(Env):
    """An environment around another one; forwards everything that it does not change.

    Attributes:
        env: The environment inside.
    """

    rollout_order: RolloutOrder = RolloutOrder.AT_ONCE

    def __init__(self, env: Env) -> None:
        """Wraps an environment.

        Args:
            env: The environment.

        Raises:
            TypeError: It is not an environment.
        """
        checks.environment(env)
        self.env = env

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode.

        Raises:
            ValueError: The environment is float64 and JAX x64 is off.
        """
        return self.env.reset(rng)

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances by one step.

        Raises:
            TypeError: The state or the action has the wrong type.
            ValueError: The state comes from another environment, or the action has the
                wrong shape.
        """
        return self.env.step(state, action, params)

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return self.env.observation_size

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return self.env.action_size

    @property
    def dtype(self) -> np.dtype:
        """Type of every floating-point array of a state, and of the actions."""
        return self.env.dtype

    @property
    def dt(self) -> float:
        """Duration of a step [s]."""
        return self.env.dt

    @property
    def name(self) -> str:
        """Name of the robot or of the task."""
        return self.env.name

    @property
    def default_params(self) -> Params:
        """Default ``params`` of a step; ``None`` if there are no parameters."""
        return self.env.default_params

    @property
    def unwrapped(self) -> Env:
        """The environment inside all wrappers."""
        return self.env.unwrapped

    def with_base(self, change: Callable[[Env], Env]) -> Env:
        """Returns the same wrappers around another environment."""
        changed = copy.copy(self)
        changed.env = self.env.with_base(change)
        return changed

    def with_scene(self, scene: Scene | None) -> Env:
        """Returns the same wrappers around the same robot in another scene."""
        return self.with_base(lambda base: base.with_scene(scene))

    def with_robot(self, robot: RobotSpec) -> Env:
        """Returns the same wrappers around the same task for another robot."""
        return self.with_base(lambda base: base.with_robot(robot))

    def with_material(self, material: Material) -> Env:
        """Returns the same wrappers around the same robot with another material."""
        return self.with_base(lambda base: base.with_material(material))

    def __dir__(self) -> list[str]:
        inside = [name for name in dir(self.env) if not name.startswith("_")]
        return sorted({*super().__dir__(), *inside})

    def __getattr__(self, name: str) -> Any:
        """Forwards to the environment inside: ``batch_size``, descriptors, ``system``.

        Raises:
            AttributeError: No environment inside has the attribute, or a property of
                this wrapper raises one.
        """
        # Private names are not forwarded. While Python copies a wrapper, ``env`` does
        # not exist yet: reading it here would recurse without end.
        if name.startswith("_") or name == "env":
            raise AttributeError(
                f"{type(self).__name__!r} object has no attribute {name!r}"
            )
        raise_own_error(self, name)
        return getattr(self.env, name)
