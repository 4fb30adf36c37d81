"""UR5e: touch one target after another with the hand of an arm."""

from __future__ import annotations

from newton_qd.envs.options import checked_options
from newton_qd.envs.targets import GROUND, Pursuit
from newton_qd.robots import UR5E


class Ur5e(Pursuit):
    """An arm of six hinges, driven by torques, that touches one target after another.

    Reward: a tenth of the way of ``wrist_3_link`` towards the target, and 1 when it is
    within 2 cm of the target. The target then moves to a random place. Never done.
    Nothing touches.

    Metrics:
        hits: 1 if the target was reached, else 0.
        weightedHits: The same.
        movingToTarget: A tenth of the way towards the target [m].
    """

    _radius, _spread = 0.02, 0.5
    _bodies = (
        GROUND,
        "shoulder_link",
        "upper_arm_link",
        "forearm_link",
        "wrist_1_link",
        "wrist_2_link",
        "wrist_3_link",
        "target",
    )

    @checked_options
    def __init__(
        self, *, reset_noise_scale: float = 0.0, dtype: str = "float32"
    ) -> None:
        """Loads the arm.

        Args:
            reset_noise_scale: Half width of the uniform noise on joint angles [rad]
                and joint velocities [rad/s] at a reset.
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.

        Raises:
            TypeError: An option has the wrong type.
            ValueError: An option has a value that is not allowed.
        """
        super().__init__(UR5E, reset_noise_scale=reset_noise_scale, dtype=dtype)
