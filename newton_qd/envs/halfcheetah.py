"""Halfcheetah: run along x on a back and a front leg, in a plane."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd.envs import planar
from newton_qd.envs.base import PhysicsEnv
from newton_qd.envs.options import checked_options
from newton_qd.envs.vectors import ordered_sum, rounded
from newton_qd.physics.system import PhysicsState
from newton_qd.robots import HALFCHEETAH
from newton_qd.types import Action, Metrics


class HalfCheetah(PhysicsEnv):
    """A trunk on two legs of three joints, rewarded for velocity along x.

    Reward: velocity along x minus a cost of control. Never done.

    Metrics:
        x_position: x of the trunk [m].
        x_velocity: Its velocity along x [m/s].
        reward_run: Velocity along x times its weight.
        reward_ctrl: Minus the cost of control [-].
    """

    forward_reward_name = "reward_run"

    @checked_options
    def __init__(
        self,
        *,
        forward_reward_weight: float = 1.0,
        ctrl_cost_weight: float = 0.1,
        reset_noise_scale: float = 0.1,
        exclude_current_positions_from_observation: bool = True,
        dtype: str = "float32",
    ) -> None:
        """Loads the halfcheetah.

        Args:
            forward_reward_weight: Weight of the velocity along x [s/m].
            ctrl_cost_weight: Cost of the sum of squared actions [-].
            reset_noise_scale: Half width of the uniform noise on joint angles [rad]
                and joint velocities [rad/s] at a reset.
            exclude_current_positions_from_observation: Whether the observation
                omits x of the torso.
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.

        Raises:
            TypeError: An option has the wrong type.
            ValueError: An option has a value that is not allowed.
        """
        self._forward_reward_weight = forward_reward_weight
        self._ctrl_cost_weight = ctrl_cost_weight
        self._omit_x = exclude_current_positions_from_observation
        super().__init__(HALFCHEETAH, reset_noise_scale=reset_noise_scale, dtype=dtype)

    def observe(self, state: PhysicsState, action: Action) -> dict[str, jax.Array]:
        """Returns the blocks of the observation."""
        del action
        half = state.q[planar.PITCH] / 2
        turned = jnp.stack([jnp.cos(half), jnp.sin(half)])
        orientation = {"torso orientation w y": turned}
        return planar.blocks(state, orientation, omit_x=self._omit_x)

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        velocity = planar.forward_velocity(before, after, self.dt)
        forward = rounded(self._forward_reward_weight * velocity)
        control = rounded(self._ctrl_cost_weight * ordered_sum(jnp.square(action)))
        metrics = {
            "x_position": after.q[planar.X],
            "x_velocity": velocity,
            "reward_run": forward,
            "reward_ctrl": -control,
        }
        return forward - control, jnp.zeros_like(forward), metrics
