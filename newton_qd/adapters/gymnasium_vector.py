"""Environments for Gymnasium, of many worlds at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from newton_qd import checks
from newton_qd.adapters.gymnasium import (
    RENDER_MODES,
    WithLength,
    check_pictures,
    check_reset_options,
    ends_of,
    info_of,
    metadata_of,
    require_no_fork,
    spaces_of,
    steps_of,
)
from newton_qd.adapters.live_camera import LiveCamera
from newton_qd.adapters.pickled import Pickled
from newton_qd.adapters.worlds import one_world
from newton_qd.checks import message
from newton_qd.envs.base import Env
from newton_qd.envs.state import State, select
from newton_qd.errors import MissingExtra
from newton_qd.wrappers import VectorWrapper

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise MissingExtra("gymnasium", "gym") from error


class GymnasiumVectorEnv(Pickled, WithLength, gymnasium.vector.VectorEnv):  # pyright: ignore[reportIncompatibleVariableOverride]
    """A batch of worlds as a vector environment of Gymnasium.

    A step of all worlds is one call. World ``i`` after ``reset(seed=n)`` begins as
    ``GymnasiumEnv`` after ``reset(seed=n + i)``. A world that ended begins a new
    episode from a new random state, as ``metadata["autoreset_mode"]`` says:

    - ``NEXT_STEP``: the next step is the reset. It ignores the action of this world,
      and its reward is 0.
    - ``SAME_STEP``: the step that ends an episode returns the first observation of the
      next one. ``info`` has ``final_obs`` and ``final_info``.
    - ``DISABLED``: ``reset(options={"reset_mask": ended})`` resets worlds.

    Attributes:
        env: The environment inside, of all worlds.
        state: Its present state.
    """

    rebuilt = ("_reset", "_step", "_place", "_keys")
    metadata: dict[str, Any] = {  # noqa: RUF012 - as in Gymnasium
        "render_modes": list(RENDER_MODES),
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        env: str | Env,
        num_envs: int = 1,
        *,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        max_episode_steps: int | None = None,
        **options: Any,
    ) -> None:
        """Builds the environment.

        Args:
            env: Name of an environment, or one of one world without auto-reset.
            num_envs: Number of worlds.
            autoreset_mode: When a world that ended is reset; a member of
                ``AutoresetMode`` or its value.
            render_mode: ``"rgb_array"`` or ``None``.
            width: Width of the picture of a world [px].
            height: Height of the picture of a world [px].
            max_episode_steps: Steps after which an episode is truncated, with
                ``action_repeat`` control steps each; ``None``: as ``options`` or
                ``env`` say. An ``env`` that is no name has its own number.
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
        steps = max_episode_steps
        checks.integer("max_episode_steps", steps, optional=True)
        if steps is not None and isinstance(env, str):
            repeat = options.get("action_repeat", 1)
            checks.integer("action_repeat", repeat)
            options["episode_length"] = steps * repeat
        checks.integer("num_envs", num_envs)
        world = one_world(env, options)
        if steps is not None and steps != steps_of(world):
            own = steps_of(world)
            allowed = (
                "None" if own is None else f"None, or {own} as the environment has"
            )
            raise ValueError(message("max_episode_steps", steps, allowed))
        if autoreset_mode not in (*AutoresetMode, *(m.value for m in AutoresetMode)):
            allowed = checks.listed([mode.value for mode in AutoresetMode])
            raise ValueError(message("autoreset_mode", autoreset_mode, allowed))
        self._mode = AutoresetMode(autoreset_mode)
        self.env = VectorWrapper(world, num_envs)
        self.metadata = metadata_of(world, autoreset_mode=self._mode)
        self.num_envs, self.render_mode = num_envs, render_mode
        seen, taken = spaces_of(world)
        self.single_observation_space, self.single_action_space = seen, taken
        self.observation_space = batch_space(seen, num_envs)
        self.action_space = batch_space(taken, num_envs)
        self.state: State | None = None
        self._rebuild()
        self._eyes: list[LiveCamera] = []
        if render_mode is not None:
            self._eyes = [LiveCamera(world, width, height) for _ in range(num_envs)]
        self._ended = np.zeros(num_envs, bool)
        self._spare: State | None = None
        self._used = 0

    def _rebuild(self) -> None:
        self._reset = jax.jit(jax.vmap(self.env.env.reset))
        self._step = jax.jit(self.env.step)
        self._place = jax.jit(_placed)
        self._keys = jax.jit(jax.vmap(jax.random.key))

    def reset(
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins an episode in all worlds, or in some.

        Args:
            seed: Seed of this and of later resets, or one for each world; ``None``: the
                next random numbers.
            options: ``{"reset_mask": mask}`` with booleans (num_envs,) resets only
                these worlds.

        Returns:
            Observations (num_envs, no) and info.

        Raises:
            ValueError: The mask or the seeds have the wrong shape, a seed is not an
                integer, or there is another option.
            gymnasium.error.ResetNeeded: There is a mask, and there was no reset.
        """
        check_reset_options(options, "reset_mask")
        seeds = None if seed is None else self._seeds(seed)
        if seeds is not None:
            super().reset(seed=seeds[0])
            self._spare = None
        mask = (options or {}).get("reset_mask")
        if mask is not None:
            self._reset_some(np.asarray(mask), seeds)
        else:
            self.state = self._fresh(seeds)
            self._ended = np.zeros(self.num_envs, bool)
        assert self.state is not None
        return np.array(self.state.obs), info_of(self.state)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advances all worlds by one control step.

        Args:
            actions: (num_envs, nu) actions; converted to the dtype of the environment.

        Returns:
            Observations (num_envs, no), rewards, terminated, truncated (num_envs,) and
            info.

        Raises:
            gymnasium.error.ResetNeeded: There was no reset.
            ValueError: The actions have the wrong shape.
        """
        if self.state is None:
            raise gymnasium.error.ResetNeeded("step: call reset first")
        begins = self._ended
        state = self._step(self.state, np.asarray(actions, self.env.dtype))
        if self._mode is AutoresetMode.NEXT_STEP and begins.any():
            state = self._begun(state, begins)
        self.state = state
        terminated, truncated = ends_of(self.env, state)
        ended = terminated | truncated
        reward, info = np.array(state.reward), info_of(state)
        if self._mode is AutoresetMode.NEXT_STEP:
            reward[begins] = 0  # some tasks have a reward after a reset
        if self._mode is AutoresetMode.SAME_STEP and ended.any():
            final = {"final_obs": np.array(state.obs), "final_info": info}
            self.state = self._begun(state, ended)
            info = {**info_of(self.state), **final}
            info |= {f"_{name}": ended.copy() for name in final}
        else:
            self._ended = ended
        return np.array(self.state.obs), reward, terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Returns a picture (height, width, 3) of each world; ``None`` without a mode.

        Raises:
            gymnasium.error.ResetNeeded: There was no reset.
        """
        if not self._eyes:
            return None
        if self.state is None:
            raise gymnasium.error.ResetNeeded("render: call reset first")
        state = jax.tree.map(np.asarray, self.state)
        return tuple(
            eye.picture(jax.tree.map(lambda leaf, n=n: leaf[n], state))
            for n, eye in enumerate(self._eyes)
        )

    def _reset_some(self, mask: np.ndarray, seeds: Sequence[int] | None) -> None:
        """Resets the worlds of a mask.

        Raises:
            ValueError: The mask has the wrong shape or type, or chooses no world.
            gymnasium.error.ResetNeeded: There was no reset.
        """
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            allowed = f"booleans ({self.num_envs},), at least one of them True"
            raise ValueError(message("options['reset_mask']", mask, allowed))
        if self.state is None:
            raise gymnasium.error.ResetNeeded("reset_mask: reset all worlds first")
        if seeds is None:
            self.state = self._begun(self.state, mask)
        else:
            own = np.arange(self.num_envs)
            self.state = self._place(self.state, self._fresh(seeds), mask, own)
        self._ended = self._ended & ~mask

    def _seeds(self, seed: int | Sequence[int]) -> list[int]:
        """Returns the seed of each world.

        Raises:
            ValueError: They have the wrong shape, or one is not an integer.
        """
        if isinstance(seed, (int, np.integer)):
            return [int(seed) + n for n in range(self.num_envs)]
        seeds = np.asarray(seed, object)  # integers of any size and kind
        whole = [
            isinstance(one, (int, np.integer)) and not isinstance(one, bool)
            for one in seeds.flat
        ]
        if seeds.shape != (self.num_envs,) or not all(whole):
            allowed = f"an integer, or {self.num_envs} integers"
            raise ValueError(message("seed", seed, allowed))
        return [int(one) for one in seeds]

    def _fresh(self, seeds: Sequence[int] | None) -> State:
        """Returns first states of all worlds, from seeds or from random numbers."""
        if seeds is None:
            drawn = self.np_random.integers(2**32, size=self.num_envs)
        else:
            drawn = np.array([seed % 2**32 for seed in seeds])
        return self._reset(self._keys(drawn.astype(np.uint32)))

    def _begun(self, state: State, begins: np.ndarray) -> State:
        """Returns the state with new episodes in some worlds.

        Each new episode takes a first state out of a stock, which is filled when it is
        empty. So a reset of all worlds is computed once for as many episodes.
        """
        count = int(begins.sum())
        if self._spare is None or self._used + count > self.num_envs:
            self._spare, self._used = self._fresh(None), 0
        source = self._used + np.cumsum(begins) - 1
        self._used += count
        return self._place(state, self._spare, begins, np.maximum(source, 0))


def _placed(state: State, spare: State, begins: jax.Array, source: jax.Array) -> State:
    """Replaces the states of some worlds by those of a stock.

    Args:
        state: State of all worlds.
        spare: The stock.
        begins: (worlds,) which are replaced.
        source: (worlds,) index in the stock of each world that is replaced.
    """
    chosen = jax.tree.map(lambda leaf: leaf[source], spare)
    return select(begins, chosen, state)


def make_gymnasium_vector(
    env: str | Env, num_envs: int, **options: Any
) -> GymnasiumVectorEnv:
    """Makes a vector environment of Gymnasium.

    Args:
        env: Name of an environment, or one of one world without auto-reset.
        num_envs: Number of worlds.
        **options: Those of :class:`GymnasiumVectorEnv`: ``autoreset_mode``,
            ``render_mode``, and the arguments of ``newton_qd.create``.

    Raises:
        TypeError: An argument has the wrong type, or is unknown.
        ValueError: A value is not allowed.
        UnknownEnvironment: The name is not registered.
    """
    return GymnasiumVectorEnv(env, num_envs, **options)
