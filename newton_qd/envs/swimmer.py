"""Swimmer: swim along x in a plane by bending two joints."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import physics
from newton_qd.envs.base import PhysicsEnv
from newton_qd.envs.options import checked_options
from newton_qd.envs.state import select
from newton_qd.envs.vectors import length, ordered_sum, rounded, wrapped
from newton_qd.physics.system import Kinematics, PhysicsState
from newton_qd.robots import SWIMMER
from newton_qd.types import Action, Metrics

_LINKS = ("torso", "mid", "back")
_YAW, _JOINTS = 2, 3  # coordinates; x and y of the torso are before them

# The water, and the inertia of the link for which the original computes the drag. The
# drag is that of a box with the same moments of inertia (MuJoCo's inertia-box model,
# but with sides of a sixth).
_VISCOSITY, _DENSITY = 0.1, 10.0  # [N s/m^2], [kg/m^3]
_MASS = 34.557519189487735  # [kg]
_MOMENTS = np.array([0.1727875959474387, 3.5709436495803999, 3.5709436495803999])
_SIDES = np.sqrt((_MOMENTS.sum() - 2 * _MOMENTS) / (6 * _MASS))  # [m]
_LINEAR = 3 * np.pi * _SIDES.mean() * _VISCOSITY  # [N s/m]
# along and across a link [N s^2/m^2]
_QUADRATIC = 0.5 * _DENSITY * _SIDES.prod() / _SIDES[:2]


class Swimmer(PhysicsEnv):
    """Three links in a row that float in water, rewarded for velocity along x.

    Reward: velocity of the centre of mass along x, minus a cost of control. Never done.
    The drag of the water acts at the centre of mass of each link, against its velocity.
    It is larger across the link than along it. It is computed once per step, from the
    state at the start.

    Metrics:
        reward_fwd: Velocity of the centre of mass along x times its weight.
        reward_ctrl: Minus the cost of control [-].
        x_position: x of the centre of mass of all links [m].
        y_position: Its y [m].
        distance_from_origin: Distance of the first link's centre of mass from the
            origin [m].
        x_velocity: Velocity of the centre of mass along x [m/s].
        y_velocity: Velocity of the centre of mass along y [m/s].
        forward_reward: The same as ``reward_fwd``.
    """

    forward_reward_name = "reward_fwd"

    @checked_options
    def __init__(
        self,
        *,
        forward_reward_weight: float = 1.0,
        ctrl_cost_weight: float = 1e-4,
        reset_noise_scale: float = 0.1,
        exclude_current_positions_from_observation: bool = True,
        dtype: str = "float32",
    ) -> None:
        """Loads the swimmer.

        Args:
            forward_reward_weight: Reward of a velocity along x [s/m].
            ctrl_cost_weight: Cost of the sum of squared actions [-].
            reset_noise_scale: Half width of the uniform noise on joint angles [rad]
                and joint velocities [rad/s] at a reset.
            exclude_current_positions_from_observation: Whether the observation
                omits x and y of the torso.
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.

        Raises:
            TypeError: An option has the wrong type.
            ValueError: An option has a value that is not allowed.
        """
        self._forward_reward_weight = forward_reward_weight
        self._ctrl_cost_weight = ctrl_cost_weight
        self._omit_xy = exclude_current_positions_from_observation
        super().__init__(SWIMMER, reset_noise_scale=reset_noise_scale, dtype=dtype)

    @property
    def action_size(self) -> int:
        """Length of an action, without the controls that apply the drag."""
        return self.system.nu - _JOINTS

    def observe(self, state: PhysicsState, action: Action) -> dict[str, jax.Array]:
        """Returns the blocks of the observation."""
        del action
        q, v = state.q, state.v
        blocks = {} if self._omit_xy else {"torso position x y [m]": q[:_YAW]}
        return blocks | {
            "torso heading [rad]": wrapped(q[_YAW:_JOINTS]),
            "joint angles [rad]": q[_JOINTS:],
            "torso velocity x y [m/s]": v[:_YAW],
            "torso angular velocity z [rad/s]": v[_YAW:_JOINTS],
            "joint velocities [rad/s]": v[_JOINTS:],
        }

    def control(self, state: PhysicsState, action: Action) -> jax.Array:
        """Returns the action plus the drag of the water, for all coordinates (5,)."""
        finite = jnp.all(jnp.isfinite(state.q)) & jnp.all(jnp.isfinite(state.v))
        state = select(finite, state, self._rest())  # its gradient too
        drag = self._drag(state)
        scale = 1 / jnp.asarray(self.system.gear[:2], self.dtype)
        return jnp.concatenate(
            [action + rounded(scale * drag[_JOINTS:]), drag[:_JOINTS]]
        )

    def _drag(self, state: PhysicsState) -> jax.Array:
        """Returns the generalized force (nv,) of the water [N or N m]."""
        seen = physics.forward_kinematics(self.system, state.q, state.v)
        bodies = self._bodies
        force = self._forces(state.q, seen.linear_velocity[bodies, :2])
        centre, joint = seen.com[bodies, :2], seen.position[bodies, :2]
        torques = []
        for first in range(len(_LINKS)):
            # the torque of a joint sums over its link and all links behind it
            arm, push = centre[first:] - joint[first][None], force[first:]
            left, right = arm[:, 0] * push[:, 1], arm[:, 1] * push[:, 0]
            torques.append(ordered_sum(rounded(left) - rounded(right)))
        return jnp.concatenate([ordered_sum(force), jnp.stack(torques)])

    def _forces(self, q: jax.Array, velocity: jax.Array) -> jax.Array:
        """Returns the drag (3, 2) on links that move at ``velocity`` (3, 2) [N]."""
        turns = q[_YAW:]
        heading = jnp.stack([turns[0], ordered_sum(turns[:2]), ordered_sum(turns)])
        along = jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=1)
        across = jnp.stack([-along[:, 1], along[:, 0]], axis=1)
        force = -rounded(jnp.asarray(_LINEAR, self.dtype) * velocity)
        for axis, coefficient in zip((along, across), _QUADRATIC, strict=True):
            speed = ordered_sum((axis * velocity).T)
            square = jnp.asarray(coefficient, self.dtype) * jnp.abs(speed) * speed
            force = force - rounded(square[:, None] * axis)
        return force

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        start, end = (
            physics.forward_kinematics(self.system, s.q, s.v) for s in (before, after)
        )
        position = self._centre_of_mass(end)
        velocity = (position - self._centre_of_mass(start)) / self.dt
        forward = rounded(self._forward_reward_weight * velocity[0])
        control = rounded(self._ctrl_cost_weight * ordered_sum(jnp.square(action)))
        metrics = {
            "reward_fwd": forward,
            "reward_ctrl": -control,
            "x_position": position[0],
            "y_position": position[1],
            "distance_from_origin": length(end.com[self.system.torso]),
            "x_velocity": velocity[0],
            "y_velocity": velocity[1],
            "forward_reward": forward,
        }
        return forward - control, jnp.zeros_like(forward), metrics

    def _centre_of_mass(self, seen: Kinematics) -> jax.Array:
        """Returns x and y of the centre of mass (2,) [m]."""
        mass = self.system.mass[self._bodies]
        share = mass / mass[0]  # exactly 1 for links of equal mass
        weights = jnp.asarray(share, self.dtype)[:, None]
        total = np.asarray(share.sum(), self.dtype)
        return ordered_sum(rounded(weights * seen.com[self._bodies, :2])) / total

    @property
    def _bodies(self) -> np.ndarray:
        """Bodies of the links (3,)."""
        names = self.system.body_names
        return np.array([names.index(name) for name in _LINKS], np.int32)
