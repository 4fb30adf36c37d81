"""Environments for Gymnasium, of one world.

Importing this module registers every environment with Gymnasium, such as
``newton_qd/ant_uni-v0``.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from newton_qd import checks, registry
from newton_qd.adapters.live_camera import LiveCamera
from newton_qd.adapters.pickled import Pickled
from newton_qd.adapters.worlds import one_world
from newton_qd.checks import listed, message
from newton_qd.envs.base import Env
from newton_qd.envs.state import State
from newton_qd.errors import MissingExtra
from newton_qd.types import READINGS

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.envs.registration import EnvSpec
except ModuleNotFoundError as error:
    raise MissingExtra("gymnasium", "gym") from error

NAMESPACE = "newton_qd"
RENDER_MODES = ("rgb_array",)
_SHOWN = ("fault", "steps", *READINGS)  # keys of ``State.info`` that ``info`` has


_PROCESSES: list[int] = []
"""The process that made the first environment; a forked one inherits it."""


def require_no_fork() -> None:
    """Refuses a process that was forked: JAX would wait in it forever.

    Raises:
        RuntimeError: Another process made environments before the fork.
    """
    if not _PROCESSES:
        _PROCESSES.append(os.getpid())
    if os.getpid() not in _PROCESSES:
        raise RuntimeError(
            "this process was forked after the first environment was made, and JAX "
            "does not run in it; start processes with spawn, or step many worlds in "
            "this one: gymnasium.make_vec(name, num_envs=N)"
        )


def spaces_of(env: Env) -> tuple[spaces.Box, spaces.Box]:
    """Returns the spaces of observations and of actions."""
    dtype: Any = env.dtype.type
    seen = spaces.Box(-np.inf, np.inf, (env.observation_size,), dtype)
    return seen, spaces.Box(-1.0, 1.0, (env.action_size,), dtype)


def check_pictures(render_mode: str | None, width: int, height: int) -> None:
    """Checks the options of pictures, also if nobody asks for pictures.

    Raises:
        ValueError: ``render_mode`` is not allowed, or ``width`` or ``height`` is not an
            integer from 1.
    """
    if render_mode is not None:
        checks.choice("render_mode", render_mode, RENDER_MODES)
    checks.integer("width", width)
    checks.integer("height", height)


def metadata_of(env: Env, **more: Any) -> dict[str, Any]:
    """Returns the metadata of an environment."""
    rate = max(1, round(1 / env.dt))
    return {"render_modes": list(RENDER_MODES), "render_fps": rate, **more}


def ends_of(env: Env, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Returns whether worlds are terminated, and whether they are truncated.

    Both are true where an episode ended by itself in its last step, as with
    Gymnasium's ``TimeLimit``, which ``gymnasium.make(env.spec)`` adds. An environment
    of your own without ``steps`` in its ``info`` does not tell the last step: there,
    ``truncation`` alone counts.
    """
    done = np.asarray(state.done) > 0
    if "truncation" not in state.info:
        return done, np.zeros_like(done)
    truncated = np.asarray(state.info["truncation"]) > 0
    terminated = done & ~truncated
    actions = steps_of(env)
    if actions is not None and "steps" in state.info:
        # a fault within the last action stops the count before its end
        before = (actions - 1) * getattr(env, "action_repeat", 1)
        truncated = truncated | (np.asarray(state.info["steps"]) > before)
    return terminated, truncated


def info_of(state: State) -> dict[str, np.ndarray]:
    """Returns metrics and readings by name, copied: nobody else changes them."""
    shown = {key: state.info[key] for key in _SHOWN if key in state.info}
    found = {**state.metrics, **shown}
    return {name: np.array(value)[()] for name, value in found.items()}


def check_reset_options(options: Mapping[str, Any] | None, *known: str) -> None:
    """Checks that the options of a reset exist.

    Raises:
        ValueError: One does not.
    """
    unknown = sorted(set(options or {}) - set(known), key=str)
    if unknown:
        raise ValueError(message("options", unknown[0], listed(known)))


def steps_of(env: Env) -> int | None:
    """Returns the actions of an episode; ``None`` if there is no limit."""
    length = getattr(env, "episode_length", None)
    return None if length is None else -(-length // getattr(env, "action_repeat", 1))


class WithLength:
    """An environment whose spec says how long its episodes are."""

    env: Any
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """What ``gymnasium.make`` was asked for, with ``max_episode_steps``.

        Gymnasium leaves it out, because no wrapper of its own ends the episodes.
        """
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None and spec.max_episode_steps is None:
            spec = dataclasses.replace(spec, max_episode_steps=steps_of(self.env))
        self._spec = spec


def _key(seed: int) -> jax.Array:
    return jax.random.key(seed % 2**32)  # JAX counts in 32 bits


class GymnasiumEnv(Pickled, WithLength, gymnasium.Env):  # pyright: ignore[reportIncompatibleVariableOverride]
    """One world as an environment of Gymnasium.

    Observations, rewards and ends are bitwise those of ``jax.jit(env.step)``. An
    episode that reaches ``episode_length`` is truncated; every other end terminates it,
    also one in the last step.
    ``info`` has the metrics, and from ``State.info`` the steps, the fault, the state
    descriptor and the position. ``reset(seed=n)`` is ``env.reset(jax.random.key(n))``.

    Attributes:
        env: The environment inside.
        state: Its present state.
    """

    rebuilt = ("_reset", "_step")
    metadata: dict[str, Any] = {  # noqa: RUF012 - as in Gymnasium
        "render_modes": list(RENDER_MODES),
        "render_fps": 20,
    }

    def __init__(
        self,
        env: str | Env,
        *,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        **options: Any,
    ) -> None:
        """Builds the environment.

        Args:
            env: Name of an environment, or one of one world without auto-reset.
            render_mode: ``"rgb_array"`` or ``None``.
            width: Width of a picture [px].
            height: Height of a picture [px].
            **options: Arguments of ``newton_qd.create``, such as ``episode_length``.

        Raises:
            TypeError: An argument has the wrong type, or is unknown.
            ValueError: A value is not allowed, or the environment has a batch or
                auto-reset.
            UnknownEnvironment: The name is not registered.
            RuntimeError: The process was forked after the first environment was made.
        """
        require_no_fork()
        check_pictures(render_mode, width, height)
        self.env = one_world(env, options)
        self.metadata = metadata_of(self.env)
        self.render_mode = render_mode
        self.observation_space, self.action_space = spaces_of(self.env)
        self.state: State | None = None
        self._rebuild()
        self._camera = None
        if render_mode is not None:
            self._camera = LiveCamera(self.env, width, height)

    def _rebuild(self) -> None:
        self._reset, self._step = jax.jit(self.env.reset), jax.jit(self.env.step)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins an episode.

        Args:
            seed: Seed of this and of later resets; ``None``: the next random number.
            options: ``None`` or empty: there are none.

        Returns:
            Observation (no,) and info.

        Raises:
            ValueError: There are options.
        """
        check_reset_options(options)
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**32))
        state = self._reset(_key(seed))
        self.state = state
        return np.array(state.obs), info_of(state)

    def step(
        self, action: np.ndarray
    ) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advances by one control step.

        Args:
            action: (nu,) action; converted to the dtype of the environment.

        Returns:
            Observation (no,), reward, terminated, truncated and info.

        Raises:
            gymnasium.error.ResetNeeded: There was no reset.
            ValueError: The action has the wrong shape.
        """
        if self.state is None:
            raise gymnasium.error.ResetNeeded("step: call reset first")
        state = self._step(self.state, np.asarray(action, self.env.dtype))
        self.state = state
        terminated, truncated = ends_of(self.env, state)
        ended = bool(terminated), bool(truncated)
        return np.array(state.obs), float(state.reward), *ended, info_of(state)

    def render(self) -> np.ndarray | None:
        """Returns a picture (height, width, 3), uint8; ``None`` without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: There was no reset.
        """
        if self._camera is None:
            return None
        if self.state is None:
            raise gymnasium.error.ResetNeeded("render: call reset first")
        return self._camera.picture(self.state)


def make_gymnasium(env: str | Env, **options: Any) -> GymnasiumEnv:
    """Makes an environment of Gymnasium, of one world.

    Args:
        env: Name of an environment, or one of one world without auto-reset.
        **options: Those of :class:`GymnasiumEnv`: ``render_mode``, ``episode_length``
            and the other arguments of ``newton_qd.create``.

    Raises:
        TypeError: An argument has the wrong type, or is unknown.
        ValueError: A value is not allowed.
        UnknownEnvironment: The name is not registered.
    """
    return GymnasiumEnv(env, **options)


def register_envs() -> None:
    """Registers every environment with Gymnasium, as ``newton_qd/NAME-v0``.

    Call it again after ``newton_qd.register`` of an environment of your own.
    """
    for name in registry.registered_envs():
        if f"{NAMESPACE}/{name}-v0" not in gymnasium.registry:
            gymnasium.register(
                f"{NAMESPACE}/{name}-v0",
                entry_point=f"{__name__}:GymnasiumEnv",
                vector_entry_point=f"{__name__}_vector:GymnasiumVectorEnv",
                kwargs={"env": name},
            )


register_envs()
