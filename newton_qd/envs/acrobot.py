"""Acrobot: swing two poles up and keep them there."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd.envs.base import PhysicsEnv
from newton_qd.envs.options import checked_options
from newton_qd.envs.vectors import ordered_sum, rounded, wrapped
from newton_qd.physics.system import PhysicsState
from newton_qd.robots import ACROBOT
from newton_qd.types import Action, Metrics


class Acrobot(PhysicsEnv):
    """Two poles that hang from a mount. The joint between them is driven.

    The task is to swing them upright. Reward: 10, minus the squared joint angles, minus
    a penalty for the joint velocities. The angles are 0 when the poles stand. Never
    done.

    Metrics:
        dist_penalty: Sum of the squared joint angles [rad^2].
        vel_penalty: Penalty for the joint velocities [-].
        alive_bonus: 0, as in the original; the 10 is in the reward only.
        r_tot: The reward [-].
    """

    @checked_options
    def __init__(
        self, *, reset_noise_scale: float = 0.01, dtype: str = "float32"
    ) -> None:
        """Loads the acrobot.

        Args:
            reset_noise_scale: Half width of the uniform noise on joint angles [rad]
                and joint velocities [rad/s] at a reset.
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.

        Raises:
            TypeError: An option has the wrong type.
            ValueError: An option has a value that is not allowed.
        """
        super().__init__(ACROBOT, reset_noise_scale=reset_noise_scale, dtype=dtype)

    def observe(self, state: PhysicsState, action: Action) -> dict[str, jax.Array]:
        """Returns the blocks of the observation."""
        del action
        return {
            "joint angles [rad]": wrapped(state.q),
            "joint velocities [rad/s]": state.v,
        }

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        del before, action
        distance = ordered_sum(jnp.square(wrapped(after.q)))
        speed = rounded(1e-3 * ordered_sum(jnp.square(after.v)))
        reward = 10 - distance - speed
        zero = jnp.zeros_like(reward)
        metrics = {
            "dist_penalty": distance,
            "vel_penalty": speed,
            # stays 0, as in the original
            "alive_bonus": zero,
            "r_tot": reward,
        }
        return reward, zero, metrics
