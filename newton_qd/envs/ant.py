"""Ant: run along x on four legs."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.envs.base import PhysicsEnv
from newton_qd.envs.contacts import angular_changes, linear_changes, padded
from newton_qd.envs.limits import survival, within
from newton_qd.envs.options import checked_options
from newton_qd.envs.vectors import length, ordered_sum, rounded
from newton_qd.physics.system import PhysicsState
from newton_qd.robots import ANT
from newton_qd.types import Action, Metrics

_CONTACT_CLIP = 1.0  # limit of observed contact velocity changes [m/s or rad/s]
_ROOT_Q, _ROOT_V = 7, 6  # a free root has 7 coordinates and 6 velocities


class Ant(PhysicsEnv):
    """A torso on four legs of two joints, rewarded for velocity along x.

    Reward: velocity along x, plus a bonus for being healthy, minus costs of control and
    of contact. Done when unhealthy.

    Metrics:
        reward_forward: Velocity of the torso along x [m/s].
        forward_reward: The same.
        reward_survive: Bonus for being healthy [-].
        reward_ctrl: Minus the cost of control [-].
        reward_contact: Minus the cost of contact [-].
        x_position: x of the torso [m].
        y_position: y of the torso [m].
        distance_from_origin: Distance of the torso from the origin, in 3D [m].
        x_velocity: Velocity of the torso along x [m/s].
        y_velocity: Velocity of the torso along y [m/s].
    """

    forward_reward_name = "reward_forward"

    @checked_options
    def __init__(
        self,
        *,
        ctrl_cost_weight: float = 0.5,
        use_contact_forces: bool = True,
        contact_cost_weight: float = 5e-4,
        healthy_reward: float = 1.0,
        terminate_when_unhealthy: bool = True,
        healthy_z_range: tuple[float, float] = (0.2, 1.0),
        reset_noise_scale: float = 0.1,
        exclude_current_positions_from_observation: bool = True,
        dtype: str = "float32",
    ) -> None:
        """Loads the ant.

        Args:
            ctrl_cost_weight: Cost of the sum of squared actions [-].
            use_contact_forces: Whether the observation ends with the contact velocity
                changes of every body, of the ground and of the walls. Those of ground
                and walls are always 0.
            contact_cost_weight: Cost of the sum of squared contact velocity changes,
                clipped as in the observation [-].
            healthy_reward: Bonus per step [-].
            terminate_when_unhealthy: Whether an unhealthy torso ends the episode;
                if not, it only loses the bonus.
            healthy_z_range: Lowest and highest healthy height of the torso [m].
            reset_noise_scale: Half width of the uniform noise on joint angles [rad]
                and joint velocities [rad/s] at a reset.
            exclude_current_positions_from_observation: Whether the observation
                omits x and y of the torso.
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.

        Raises:
            TypeError: An option has the wrong type.
            ValueError: An option has a value that is not allowed.
        """
        self._ctrl_cost_weight = ctrl_cost_weight
        self._use_contact_forces = use_contact_forces
        self._contact_cost_weight = contact_cost_weight
        self._healthy_reward = healthy_reward
        self._terminate_when_unhealthy = terminate_when_unhealthy
        self._healthy_z_range = healthy_z_range
        self._omit_xy = exclude_current_positions_from_observation
        super().__init__(ANT, reset_noise_scale=reset_noise_scale, dtype=dtype)

    def observe(self, state: PhysicsState, action: Action) -> dict[str, jax.Array]:
        """Returns the blocks of the observation."""
        del action
        q, v = state.q, state.v
        blocks = {} if self._omit_xy else {"torso position x y [m]": q[:2]}
        blocks |= {
            "torso height [m]": q[2:3],
            "torso orientation w x y z": jnp.concatenate([q[6:7], q[3:6]]),
            "joint angles [rad]": q[_ROOT_Q:],
            "torso velocity x y z [m/s]": v[:3],
            "torso angular velocity x y z [rad/s]": v[3:_ROOT_V],
            "joint velocities [rad/s]": v[_ROOT_V:],
        }
        if self._use_contact_forces:
            bodies = np.arange(self.system.nb, dtype=np.int32)
            linear = _clipped(linear_changes(self.system, state, bodies))
            angular = _clipped(
                angular_changes(self.system, state, bodies, "use_contact_forces=True")
            )
            still = ("ground", *self.system.scene_links)
            names = ", ".join(("bodies", *still[:-1])) + f" and {still[-1]}"
            blocks |= {
                f"contact velocity changes, {names} [m/s]": padded(linear, len(still)),
                f"contact angular velocity changes, {names} [rad/s]": padded(
                    angular, len(still)
                ),
            }
        return blocks

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        position = after.q[:3]
        velocity = rounded((position[:2] - before.q[:2]) / self.dt)
        healthy = within(position[2], self._healthy_z_range, self.termination_width)
        ends = self._terminate_when_unhealthy
        bonus, done = survival(healthy, self._healthy_reward, ends=ends)
        control = rounded(self._ctrl_cost_weight * ordered_sum(jnp.square(action)))
        contact = rounded(self._contact_cost_weight * self._contact_effort(after))
        reward = velocity[0] + bonus - control - contact
        metrics = {
            "reward_forward": velocity[0],
            "forward_reward": velocity[0],
            "reward_survive": bonus,
            "reward_ctrl": -control,
            "reward_contact": -contact,
            "x_position": position[0],
            "y_position": position[1],
            "distance_from_origin": length(position),
            "x_velocity": velocity[0],
            "y_velocity": velocity[1],
        }
        return reward, done, metrics

    def _contact_effort(self, state: PhysicsState) -> jax.Array:
        """Returns the sum of squared contact velocity changes [m^2/s^2]."""
        # The other bodies cannot touch anything: their terms are zero.
        touching = np.unique(self.system.contact_body).astype(np.int32)
        changes = _clipped(linear_changes(self.system, state, touching))
        return ordered_sum(jnp.square(changes).reshape(-1))


def _clipped(changes: jax.Array) -> jax.Array:
    return jnp.clip(changes, -_CONTACT_CLIP, _CONTACT_CLIP)
