"""Arm reach: bring the tip of an arm anywhere within reach, with little effort."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd import physics
from newton_qd.envs.base import PhysicsEnv
from newton_qd.envs.options import checked_options
from newton_qd.envs.points import point
from newton_qd.envs.vectors import ordered_sum
from newton_qd.physics.system import PhysicsState
from newton_qd.robots import REACHER
from newton_qd.types import Action, Metrics

TIP = ("body1", (0.11, 0.0, 0.0))
"""Link of the tip, and its centre in the frame of this link [m]."""


class ArmReach(PhysicsEnv):
    """The arm of the reacher, driven by torques.

    Reward: minus the sum of squared actions. Never done. Of all motions that bring the
    tip to a place in a given time, the fittest needs the least effort. Such a motion is
    smooth. There is no friction, so the task is harder in a short episode of 1 to 2 s
    (50 to 100 steps). The red target of the reacher is still drawn. It has no effect.

    Metrics:
        reward_ctrl: Minus the sum of squared actions [-].
    """

    reads_bodies = True

    @checked_options
    def __init__(
        self,
        *,
        reset_noise_scale: float = 0.01,
        dtype: str = "float32",
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
        super().__init__(REACHER, reset_noise_scale=reset_noise_scale, dtype=dtype)

    def observe(self, state: PhysicsState, action: Action) -> dict[str, jax.Array]:
        """Returns the blocks of the observation."""
        del action
        link, offset = TIP
        seen = physics.seen_bodies(self.system, state)
        place, velocity = point(seen, self.system.body_names.index(link), offset)
        angles = state.q[self._joint_q]
        return {
            "cosines of the joint angles": jnp.cos(angles),
            "sines of the joint angles": jnp.sin(angles),
            "joint velocities [rad/s]": state.v[self._joint_v],
            "tip position x y [m]": place[:2],
            "tip velocity x y [m/s]": velocity[:2],
        }

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        del before, after
        control = ordered_sum(jnp.square(action))
        return -control, jnp.zeros_like(control), {"reward_ctrl": -control}
