"""Walker2d: run along x on two legs, in a plane."""

from __future__ import annotations

from newton_qd.envs import planar
from newton_qd.envs.options import checked_options
from newton_qd.robots import WALKER2D
from newton_qd.scenes import Scene


class Walker2d(planar.UprightRunner):
    """A torso on two legs of three joints each, rewarded for velocity along x.

    Reward: velocity along x, plus a bonus for being healthy, minus a cost of control.
    Done when unhealthy.

    Metrics:
        reward_forward: Velocity of the torso along x times its weight.
        reward_ctrl: Minus the cost of control [-].
        reward_healthy: Bonus for being healthy [-].
        x_position: x of the torso [m].
        x_velocity: Its velocity along x [m/s].
    """

    @checked_options
    def __init__(
        self,
        *,
        forward_reward_weight: float = 1.0,
        ctrl_cost_weight: float = 1e-3,
        healthy_reward: float = 1.0,
        terminate_when_unhealthy: bool = True,
        healthy_z_range: tuple[float, float] = (0.7, 2.0),
        healthy_angle_range: tuple[float, float] = (-1.0, 1.0),
        reset_noise_scale: float = 5e-3,
        exclude_current_positions_from_observation: bool = True,
        dtype: str = "float32",
        scene: Scene | None = None,
    ) -> None:
        """Loads the walker2d.

        Args:
            forward_reward_weight: Weight of the velocity along x [s/m].
            ctrl_cost_weight: Cost of the sum of squared actions [-].
            healthy_reward: Bonus per step [-].
            terminate_when_unhealthy: Whether an unhealthy torso ends the episode;
                if not, it only loses the bonus.
            healthy_z_range: Lowest and highest healthy height of the torso [m].
            healthy_angle_range: Lowest and highest healthy pitch of the torso, an
                Euler angle between -pi/2 and pi/2 [rad].
            reset_noise_scale: Half width of the uniform noise on joint angles [rad]
                and joint velocities [rad/s] at a reset.
            exclude_current_positions_from_observation: Whether the observation
                omits x of the torso.
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.
            scene: Obstacles on the ground; ``None``: no obstacles.

        Raises:
            TypeError: An option has the wrong type.
            ValueError: An option has a value that is not allowed.
        """
        self._task = planar.UprightRun(
            forward_reward_weight=forward_reward_weight,
            ctrl_cost_weight=ctrl_cost_weight,
            healthy_reward=healthy_reward,
            terminate_when_unhealthy=terminate_when_unhealthy,
            healthy_z_range=healthy_z_range,
            healthy_angle_range=healthy_angle_range,
        )
        self._omit_x = exclude_current_positions_from_observation
        super().__init__(
            WALKER2D, reset_noise_scale=reset_noise_scale, dtype=dtype, scene=scene
        )
