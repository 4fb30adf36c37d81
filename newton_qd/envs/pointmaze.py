"""PointMaze: a point on a plane that must move around two walls."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.envs.base import QDEnv
from newton_qd.envs.inputs import (
    checked_action,
    refuse_params,
    require_key,
    require_point_state,
)
from newton_qd.envs.state import State
from newton_qd.envs.vectors import length, rounded
from newton_qd.physics.explicit_mesh import split_as
from newton_qd.types import Action, Params, RNGKey

_WALL_THICKNESS = 0.01
_HIGHEST_START = -0.7  # highest y of a reset
_START_FRACTION = 10.0  # x of a reset: from x_min / 10 to x_max / 10


class PointMaze(QDEnv):
    """A point in a box with two walls, rewarded for being near the goal.

    There is no physics. The observation, x and y of the point, is the whole state, and
    ``pipeline_state`` is empty. The lower wall has a gap at the left, the upper wall at
    the right. A point that would cross a wall stops at its face and slides along it.
    The path of the point is in the gap if it meets the height of the wall's lower face
    there. Lengths have no unit. x and y of an action are clipped to the borders.
    Reward: minus the distance to the goal. Done in the goal zone.
    """

    def __init__(
        self,
        *,
        scale_action_space: float = 10.0,
        x_min: float = -1.0,
        x_max: float = 1.0,
        y_min: float = -1.0,
        y_max: float = 1.0,
        zone_width: float = 0.1,
        zone_width_offset_from_x_min: float = 0.5,
        zone_height_offset_from_y_max: float = -0.2,
        wall_width_ratio: float = 0.75,
        upper_wall_height_offset: float = 0.2,
        lower_wall_height_offset: float = -0.5,
        dtype: str = "float32",
    ) -> None:
        """Sets up the maze.

        Args:
            scale_action_space: A step moves the point by the clipped action divided by
                this number.
            x_min: Left border of the box, at most 0. A reset puts the point between a
                tenth of ``x_min`` and of ``x_max``.
            x_max: Right border, at least 0.
            y_min: Lower border, below -0.7. A reset puts the point between ``y_min``
                and -0.7.
            y_max: Upper border.
            zone_width: Width and height of the goal zone.
            zone_width_offset_from_x_min: x of the goal, from the left border.
            zone_height_offset_from_y_max: y of the goal, from the upper border.
            wall_width_ratio: Width of each wall divided by the width of the box.
            upper_wall_height_offset: y of the lower face of the upper wall.
            lower_wall_height_offset: y of the lower face of the lower wall.
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.

        Raises:
            TypeError: An argument is not a number.
            ValueError: A number is not finite, borders or walls are in the wrong order,
                walls are wider than the box, or ``dtype`` is float64 and JAX x64 is
                off.
        """
        for name, value in (
            ("x_min", x_min),
            ("x_max", x_max),
            ("y_min", y_min),
            ("y_max", y_max),
            ("lower_wall_height_offset", lower_wall_height_offset),
            ("upper_wall_height_offset", upper_wall_height_offset),
            ("zone_width_offset_from_x_min", zone_width_offset_from_x_min),
            ("zone_height_offset_from_y_max", zone_height_offset_from_y_max),
        ):
            checks.number(name, value)
        checks.number("wall_width_ratio", wall_width_ratio, least=0, most=1)
        checks.number("scale_action_space", scale_action_space, above=0)
        checks.number("zone_width", zone_width, above=0)
        walls = lower_wall_height_offset, upper_wall_height_offset
        _require_box((x_min, x_max), (y_min, y_max), walls)
        self._dtype = checks.precision(dtype)
        self._scale = scale_action_space
        self._low = (x_min, y_min)
        self._high = (x_max, y_max)
        self._goal = (
            x_min + zone_width_offset_from_x_min,
            y_max + zone_height_offset_from_y_max,
        )
        self._half_zone = zone_width / 2
        self._lower, self._upper = walls
        width = (x_max - x_min) * wall_width_ratio
        self._lower_begins = x_max - width
        self._upper_ends = x_min + width

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode at a random position at the bottom of the box.

        Raises:
            TypeError: ``rng`` is not a key.
            ValueError: ``rng`` is several keys, or the environment is float64 and JAX
                x64 is off.
        """
        checks.x64(self._dtype)
        require_key("rng", rng)
        _, x_key, y_key = jax.random.split(rng, 3)
        (left, bottom), (right, _) = self._low, self._high
        x = jax.random.uniform(x_key, (), self._dtype, left, right) / _START_FRACTION
        y = jax.random.uniform(y_key, (), self._dtype, bottom, _HIGHEST_START)
        return split_as([rng], self._first_state(jnp.stack([x, y])))

    def fixed_state(self) -> State:
        """Returns the state of a reset without noise: the mean start position.

        Raises:
            ValueError: The environment is float64 and JAX x64 is off.
        """
        checks.x64(self._dtype)
        return self._first_state(self._start())

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Moves the point, or freezes it if a value is not finite.

        Raises:
            TypeError: The state or the action has the wrong type.
            ValueError: The state comes from another environment, the action has the
                wrong shape, ``params`` are given, or the environment is float64 and
                JAX x64 is off.
        """
        checks.x64(self._dtype)
        require_point_state(state, self._dtype)
        refuse_params(params)
        action = checked_action(action, self.action_size, self._dtype)
        old = state.obs
        finite = jnp.all(jnp.isfinite(old))
        sound = finite & jnp.all(jnp.isfinite(action)) & (state.info["fault"] == 0)
        # "Double where": the move of a point that has a fault is computed with finite
        # numbers, so that its gradient is 0 and not 0 * nan.
        frozen = jax.lax.stop_gradient(jnp.where(finite, old, self._start()))
        moved = self._moved(
            jnp.where(sound, old, frozen), jnp.where(sound, action, jnp.zeros_like(old))
        )
        position = jnp.where(sound, moved, frozen)
        ends = jnp.ones((), self._dtype), jnp.zeros((), self._dtype)
        one, zero = split_as([position], ends)
        reward = -length(position - self._array(self._goal))
        return state.replace(
            obs=position,
            reward=jnp.where(sound, reward, zero),
            done=jnp.where(self._in_zone(position) | ~sound, one, zero),
            info={
                **state.info,
                "fault": (~sound).astype(jnp.int32),
                "state_descriptor": jnp.copy(position),
            },
        )

    def _moved(self, old: jax.Array, action: jax.Array) -> jax.Array:
        """Returns the position (2,) of the point after an action (2,)."""
        low, high = self._array(self._low), self._array(self._high)
        move = rounded(jnp.clip(action, low, high) / self._scale)
        new = old + move
        return jnp.clip(new.at[1].set(self._stopped(old, new)), low, high)

    def _stopped(self, old: jax.Array, new: jax.Array) -> jax.Array:
        """Returns y () of a point that stops at the first wall that it meets."""
        lower, upper = self._lower, self._upper
        up, down, x = _crossing(old, new, lower)
        lower_up, lower_down = (way & (x >= self._lower_begins) for way in (up, down))
        up, down, x = _crossing(old, new, upper)
        upper_up, upper_down = (way & (x <= self._upper_ends) for way in (up, down))
        # on the way up, a path meets the lower wall first; on the way down, the upper
        y = jnp.where(upper_up, self._array(upper), new[1])
        y = jnp.where(lower_up, self._array(lower), y)
        y = jnp.where(lower_down, self._array(lower + _WALL_THICKNESS), y)
        return jnp.where(upper_down, self._array(upper + _WALL_THICKNESS), y)

    def _in_zone(self, position: jax.Array) -> jax.Array:
        inside = jnp.ones((), jnp.bool_)
        for centre, value in zip(self._goal, position, strict=True):
            low, high = centre - self._half_zone, centre + self._half_zone
            inside = inside & (low <= value) & (value <= high)
        return inside

    def _start(self) -> jax.Array:
        (left, bottom), (right, _) = self._low, self._high
        x = (left + right) / 2 / _START_FRACTION
        return self._array((x, (bottom + _HIGHEST_START) / 2))

    def _first_state(self, position: jax.Array) -> State:
        return State(
            pipeline_state=(),
            obs=position,
            reward=jnp.zeros((), self._dtype),
            done=jnp.zeros((), self._dtype),
            metrics={},
            info={
                "fault": jnp.zeros((), jnp.int32),
                "state_descriptor": jnp.copy(position),
            },
        )

    def _array(self, values: float | tuple[float, float]) -> jax.Array:
        return jnp.asarray(values, self._dtype)

    @property
    def descriptors_min_values(self) -> list[float]:
        """Left and lower border."""
        return list(self._low)

    @property
    def descriptors_max_values(self) -> list[float]:
        """Right and upper border."""
        return list(self._high)

    @property
    def descriptors_names(self) -> list[str]:
        """Names of the descriptor's components."""
        return ["x_pos", "y_pos"]

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
        """Lower and upper borders of the box, (2,) each."""
        return self._array(self._low), self._array(self._high)

    @property
    def observation_layout(self) -> tuple[tuple[str, int], ...]:
        """Name and size of each block of the observation, in order."""
        return (("position x y", 2),)

    @property
    def reach(self) -> float:
        """Distance that an action of 1 moves the point."""
        return 1 / self._scale

    @property
    def goal(self) -> tuple[float, float]:
        """Centre of the goal zone, x and y."""
        return self._goal

    @property
    def zone_width(self) -> float:
        """Width and height of the goal zone."""
        return 2 * self._half_zone

    @property
    def walls(self) -> tuple[tuple[float, float, float, float], ...]:
        """Lowest x, lowest y, highest x and highest y of the lower and upper wall."""
        (left, _), (right, _) = self._low, self._high
        lower, upper = self._lower, self._upper
        return (
            (self._lower_begins, lower, right, lower + _WALL_THICKNESS),
            (left, upper, self._upper_ends, upper + _WALL_THICKNESS),
        )

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return 2

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return 2

    @property
    def dtype(self) -> np.dtype:
        """Type of every floating-point array of a state, and of the actions."""
        return self._dtype

    @property
    def dt(self) -> float:
        """Duration of a step, always 1: the maze counts time in steps."""
        return 1.0

    @property
    def name(self) -> str:
        """Name of the task."""
        return "pointmaze"


def _crossing(
    old: jax.Array, new: jax.Array, height: float
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns how the path from ``old`` to ``new`` (2,) meets the height of a wall.

    Returns:
        Whether it crosses the lower face on the way up (), and the upper face on the
        way down (). And x () at which it meets the lower face, which is finite but has
        no meaning if it crosses neither.
    """
    (x_old, y_old), (x, y) = old, new
    top = height + _WALL_THICKNESS
    up = (y_old <= height) & (height < y)
    down = (y < top) & (top <= y_old)
    # without this, a horizontal path would divide 0 by 0
    rise = jnp.where(up | down, y - y_old, jnp.ones_like(y))
    return up, down, rounded((height - y_old) / rise * (x - x_old)) + x_old


def _require_box(
    x: tuple[float, float], y: tuple[float, float], walls: tuple[float, float]
) -> None:
    """Checks borders and walls.

    Raises:
        ValueError: They are not in the right order.
    """
    if not x[0] <= 0 <= x[1] or x[0] == x[1]:
        allowed = "x_min at most 0, x_max at least 0, not both 0"
        raise ValueError(message("x_min, x_max", x, allowed))
    if not y[0] < _HIGHEST_START < y[1]:
        allowed = f"y_min below {_HIGHEST_START}, y_max above it"
        raise ValueError(message("y_min, y_max", y, allowed))
    if not y[0] < walls[0] < walls[1] < y[1]:
        name = "lower_wall_height_offset, upper_wall_height_offset"
        allowed = f"between {y[0]!r} and {y[1]!r}, the lower below the upper"
        raise ValueError(message(name, walls, allowed))
