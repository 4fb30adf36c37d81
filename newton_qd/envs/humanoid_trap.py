"""Humanoid of the trap task: other inertias, costs and contacts."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd.envs.contacts import angular_changes, linear_changes, padded
from newton_qd.envs.humanoid import Humanoid
from newton_qd.envs.options import checked_options
from newton_qd.envs.vectors import rounded
from newton_qd.physics.system import PhysicsState
from newton_qd.scenes import HUMANOID_TRAP
from newton_qd.types import Action, Metrics


class HumanoidTrap(Humanoid):
    """The humanoid in front of a trap of three walls, with a lower cost of control.

    Its shins touch the walls. The observation ends with the contact velocity changes of
    every body, of the ground and of the walls. They are not clipped.

    Metrics:
        reward_linvel: Velocity of the centre of mass along x times its weight.
        reward_quadctrl: The cost of control [-]. It is positive, as in the original.
        reward_alive: Bonus for being healthy [-].
        reward_impact: 0, as in the original.
    """

    _scene = HUMANOID_TRAP

    @checked_options
    def __init__(
        self,
        *,
        forward_reward_weight: float = 1.25,
        ctrl_cost_weight: float = 0.01,
        healthy_reward: float = 5.0,
        terminate_when_unhealthy: bool = True,
        healthy_z_range: tuple[float, float] = (0.8, 2.1),
        reset_noise_scale: float = 1e-2,
        exclude_current_positions_from_observation: bool = True,
        dtype: str = "float32",
    ) -> None:
        """Loads the humanoid.

        Args:
            forward_reward_weight: Reward of a velocity along x [s/m].
            ctrl_cost_weight: Cost of the sum of squared actions [-].
            healthy_reward: Bonus per step [-].
            terminate_when_unhealthy: Whether an unhealthy torso ends the episode.
            healthy_z_range: Lowest and highest healthy height of the torso [m].
            reset_noise_scale: Half width of the noise on joint angles [rad] and
                joint velocities [rad/s] at a reset.
            exclude_current_positions_from_observation: Whether the observation
                omits x and y of the torso.
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.

        Raises:
            TypeError: An option has the wrong type.
            ValueError: An option has a value that is not allowed.
        """
        super().__init__(
            forward_reward_weight=forward_reward_weight,
            ctrl_cost_weight=ctrl_cost_weight,
            healthy_reward=healthy_reward,
            terminate_when_unhealthy=terminate_when_unhealthy,
            healthy_z_range=healthy_z_range,
            reset_noise_scale=reset_noise_scale,
            exclude_current_positions_from_observation=(
                exclude_current_positions_from_observation
            ),
            dtype=dtype,
        )

    @property
    def name(self) -> str:
        """Name of the robot in this task."""
        return "humanoid_w_trap"

    def observe(self, state: PhysicsState, action: Action) -> dict[str, jax.Array]:
        """Returns the blocks of the observation."""
        bodies = self._bodies
        linear = linear_changes(self.system, state, bodies)
        angular = angular_changes(self.system, state, bodies, "contact changes")
        still = 1 + len(self.system.scene_links)
        names = ", ".join(("bodies", "ground", *self.system.scene_links))
        return super().observe(state, action) | {
            f"contact velocity changes, {names} [m/s]": padded(linear, still),
            f"contact angular velocity changes, {names} [rad/s]": padded(
                angular, still
            ),
        }

    def _inertia_about_centre(
        self, mass: jax.Array, arm: jax.Array, square: jax.Array
    ) -> jax.Array:
        """Returns inertias about the robot's centre of mass (n, 3, 3) [kg m^2]."""
        products = mass[:, :, None] * arm[:, :, None] * arm[:, None, :]
        return self._rotational(mass * square) - rounded(products)

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        reward, done, found = super().outcome(before, after, action)
        metrics = {
            "reward_linvel": found["reward_linvel"],
            # positive, as in the original
            "reward_quadctrl": -found["reward_quadctrl"],
            "reward_alive": found["reward_alive"],
            "reward_impact": jnp.zeros_like(reward),
        }
        return reward, done, metrics
