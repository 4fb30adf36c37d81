"""Humanoid on its back: stand up."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd.envs.humanoid import Humanoid
from newton_qd.envs.options import checked_options
from newton_qd.envs.vectors import ordered_sum, rounded
from newton_qd.physics.system import PhysicsState
from newton_qd.robots import HUMANOID_STANDUP
from newton_qd.types import Action, Metrics


class HumanoidStandup(Humanoid):
    """The humanoid on its back, rewarded for the height of its torso.

    The observation is that of ``Humanoid``. Reward: height of the torso divided by the
    duration of a step, plus 1, minus a cost of control. Never done. Torso, shins and
    lower arms touch the ground.

    Metrics:
        reward_linup: Height of the torso divided by the duration of a step [m/s].
        reward_quadctrl: Minus the cost of control [-].
    """

    forward_reward_name = None
    _spec = HUMANOID_STANDUP

    @checked_options
    def __init__(
        self,
        *,
        reset_noise_scale: float = 1e-2,
        dtype: str = "float32",
    ) -> None:
        """Loads the humanoid.

        Args:
            reset_noise_scale: Half width of the uniform noise on joint angles [rad]
                and joint velocities [rad/s] at a reset.
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.

        Raises:
            TypeError: An option has the wrong type.
            ValueError: An option has a value that is not allowed.
        """
        super().__init__(
            ctrl_cost_weight=0.01, reset_noise_scale=reset_noise_scale, dtype=dtype
        )

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        del before
        up = after.q[2] / self.dt
        control = rounded(self._ctrl_cost_weight * ordered_sum(jnp.square(action)))
        metrics = {"reward_linup": up, "reward_quadctrl": -control}
        return up + 1 - control, jnp.zeros_like(up), metrics
