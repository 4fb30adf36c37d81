"""Position of the torso, or of a point of a link, as the state descriptor."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks, physics
from newton_qd.checks import message
from newton_qd.envs.base import Env, PhysicsEnv
from newton_qd.envs.points import point
from newton_qd.envs.rollouts import RolloutOrder
from newton_qd.envs.state import State
from newton_qd.extractors import get_final_xy_position
from newton_qd.real_numbers import real_numbers
from newton_qd.types import Descriptor
from newton_qd.wrappers.base import unsupported
from newton_qd.wrappers.descriptor import DescriptorWrapper

Limits = Sequence[float] | np.ndarray | jax.Array


class XYPositionWrapper(DescriptorWrapper):
    """Writes where the torso or another link is into ``info["state_descriptor"]``.

    The state descriptor is clipped to the limits. ``info["xy_position"]`` is not
    clipped. If actions are repeated, the last repetition counts. The torso is the
    robot's first link, unless its spec names another one. The first link of an arm does
    not move, so give an arm another ``link``.
    """

    rollout_order = RolloutOrder.AT_ONCE
    descriptor_extractor = staticmethod(get_final_xy_position)

    def __init__(
        self,
        env: Env,
        env_name: str,
        minval: Limits | None = None,
        maxval: Limits | None = None,
        link: str | None = None,
        offset: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Wraps a simulated robot.

        Args:
            env: The environment.
            env_name: Its name, used in errors.
            minval: Lowest x and y of a state descriptor [m]; ``None``: no limit.
            maxval: Highest x and y, above ``minval`` [m]; ``None``: no limit.
            link: Link of the robot whose position is described, such as the hand of an
                arm; ``None``: the torso.
            offset: Point of this link, in its frame [m].

        Raises:
            NotImplementedError: The environment is not a simulated robot.
            TypeError: ``env`` is not an environment, or ``offset`` not three numbers.
            ValueError: A limit is not two finite numbers, the lowest value is not
                below the highest, the robot has no such link, or ``offset`` is not
                finite, or is given without a link.
        """
        checks.environment(env, needs="unwrapped")
        if not isinstance(env.unwrapped, PhysicsEnv):
            raise NotImplementedError(unsupported(env, env_name, "simulated robots"))
        super().__init__(env, env_name)
        self._low = _limit("minval", minval, -np.inf)
        self._high = _limit("maxval", maxval, np.inf)
        if not np.all(self._low < self._high):
            allowed = "minval below maxval in x and in y"
            raise ValueError(message("minval, maxval", (minval, maxval), allowed))
        self._link = _body(env.unwrapped, link)
        self._offset = _point(offset, link)

    def describe(self, state: State) -> Descriptor:
        """Returns the position (2,) of the torso or link, clipped to the limits [m]."""
        low, high = self.state_descriptor_limits
        return jnp.clip(self._position(state), low, high)

    def _position(self, state: State) -> jax.Array:
        """Returns x and y (2,) of the torso or link, not clipped [m]."""
        if self._link is None:
            return state.pipeline_state.torso_xy
        robot = self.unwrapped
        assert isinstance(robot, PhysicsEnv)
        seen = physics.seen_bodies(robot.system, state.pipeline_state)
        return point(seen, self._link, self._offset)[0][:2]

    def _described(self, state: State) -> State:
        read = self._position
        for _ in range(jnp.ndim(state.done)):
            read = jax.vmap(read)
        # JAX could not donate a state that has a buffer twice
        position = jnp.copy(read(state))
        state = super()._described(state)
        return state.replace(info={**state.info, "xy_position": position})

    @property
    def state_descriptor_length(self) -> int:
        """Length of a state descriptor."""
        return 2

    @property
    def state_descriptor_name(self) -> str:
        """Name of the quantity that a state descriptor measures."""
        return "xy_position"

    @property
    def state_descriptor_limits(self) -> tuple[jax.Array, jax.Array]:
        """Lower and upper limits of x and y, (2,) each [m]."""
        return jnp.asarray(self._low, self.dtype), jnp.asarray(self._high, self.dtype)


def _limit(name: str, given: Limits | None, unlimited: float) -> np.ndarray:
    """Returns a limit as (2,) numbers.

    Raises:
        ValueError: It is not two finite numbers.
    """
    if given is None:
        return np.full(2, unlimited)
    refusal = message(name, given, "None, or two finite numbers")
    limit = real_numbers(given)
    if limit is None or limit.shape != (2,) or not np.all(np.isfinite(limit)):
        raise ValueError(refusal)
    return limit


def _body(base: PhysicsEnv, link: str | None) -> int | None:
    """Returns the index of the body of a link; ``None`` for the torso.

    Raises:
        ValueError: The robot has no such link.
    """
    if link is None:
        return None
    names = base.system.body_names
    checks.choice("link", link, names)
    return names.index(link)


def _point(offset: Sequence[float], link: str | None) -> tuple[float, float, float]:
    """Returns a point in the frame of a link [m].

    Raises:
        TypeError: It is not three numbers.
        ValueError: A number is not finite, or there is no link.
    """
    allowed = "three finite numbers"
    if not isinstance(offset, Sequence) or len(offset) != 3:
        raise TypeError(message("offset", offset, allowed))
    for index, value in enumerate(offset):
        checks.number(f"offset[{index}]", value)
    if link is None and any(offset):
        allowed = "(0.0, 0.0, 0.0) without a link"
        raise ValueError(message("offset", offset, allowed))
    x, y, z = (float(value) for value in offset)
    return x, y, z
