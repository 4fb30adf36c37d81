"""Quadruped: walk along x on four legs of three joints."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd.envs.locomotion import Locomotion
from newton_qd.envs.options import checked_options
from newton_qd.envs.rollouts import RolloutOrder
from newton_qd.envs.servos import Servos
from newton_qd.physics.system import PhysicsState
from newton_qd.robots import QUADRUPED
from newton_qd.types import Action, Metrics


class Quadruped(Servos, Locomotion):
    """A torso on four legs of three joints that hold angles, rewarded for speed.

    An action from -1 to 1 is the target angle of a joint, from the lower to the upper
    end of its range. Other actions are clipped. With all actions 0 it stands. Reward:
    velocity along x, plus a bonus for being healthy, minus a cost of control, as for
    the ant. Done when the torso is too low or too high.

    Metrics:
        reward_forward: Velocity of the torso along x times its weight.
        reward_survive: Bonus for being healthy [-].
        reward_ctrl: Minus the cost of control [-].
        x_position: x of the torso [m].
        y_position: y of the torso [m].
        x_velocity: Velocity of the torso along x [m/s].
    """

    rollout_order = RolloutOrder.AT_ONCE  # the control depends on the action only

    @checked_options
    def __init__(
        self,
        *,
        forward_reward_weight: float = 1.0,
        ctrl_cost_weight: float = 0.1,
        healthy_reward: float = 1.0,
        healthy_z_range: tuple[float, float] = (0.12, 1.0),
        reset_noise_scale: float = 0.1,
        dtype: str = "float32",
    ) -> None:
        """Loads the quadruped.

        Args:
            forward_reward_weight: Weight of the velocity along x [s/m].
            ctrl_cost_weight: Cost of the sum of squared actions [-].
            healthy_reward: Bonus per step [-].
            healthy_z_range: Lowest and highest healthy height of the torso [m].
            reset_noise_scale: Half width of the uniform noise on joint angles [rad]
                and joint velocities [rad/s] at a reset.
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.

        Raises:
            TypeError: An option has the wrong type.
            ValueError: An option has a value that is not allowed.
        """
        super().__init__(
            QUADRUPED,
            forward_reward_weight=forward_reward_weight,
            ctrl_cost_weight=ctrl_cost_weight,
            healthy_reward=healthy_reward,
            healthy_z_range=healthy_z_range,
            reset_noise_scale=reset_noise_scale,
            dtype=dtype,
        )

    def control(self, state: PhysicsState, action: Action) -> jax.Array:
        """Returns the target angles of the joints (nu,) [rad]."""
        del state
        return self.servo_targets(action)

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        # a huge action is clipped, and must not cost infinitely much
        return super().outcome(before, after, jnp.clip(action, -1, 1))
