"""Reachers: bring the tip of an arm to a target that each reset draws at random."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import physics
from newton_qd.envs.base import PhysicsEnv
from newton_qd.envs.options import checked_options
from newton_qd.envs.points import point
from newton_qd.envs.rollouts import RolloutOrder
from newton_qd.envs.servos import Servos
from newton_qd.envs.vectors import length, ordered_sum
from newton_qd.physics.system import Kinematics, PhysicsState
from newton_qd.robots import REACHER, REACHERANGLE, RobotSpec
from newton_qd.types import Action, Metrics, RNGKey

_TIP = (0.11, 0.0, 0.0)  # centre of the tip in its link [m]
_FARTHEST = 0.2  # largest distance of a target from the shoulder [m]


class Reacher(PhysicsEnv):
    """An arm of two links over the ground, driven by torques.

    Reward: minus the distance of the tip from the target, minus the sum of squared
    actions. Never done. The target is a body of the simulation that does not move.

    Metrics:
        reward_dist: Minus the distance of the tip from the target [m].
        reward_ctrl: Minus the sum of squared actions [-].
    """

    _spec: RobotSpec = REACHER

    @checked_options
    def __init__(
        self,
        *,
        reset_noise_scale: float = 0.1,
        reset_velocity_noise_scale: float = 0.005,
        dtype: str = "float32",
    ) -> None:
        """Loads the arm.

        Args:
            reset_noise_scale: Half width of the uniform noise on joint angles at a
                reset [rad].
            reset_velocity_noise_scale: Half width of the noise on joint velocities
                [rad/s].
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.

        Raises:
            TypeError: An option has the wrong type.
            ValueError: An option has a value that is not allowed.
        """
        super().__init__(
            self._spec,
            reset_noise_scale=reset_noise_scale,
            reset_velocity_noise_scale=reset_velocity_noise_scale,
            dtype=dtype,
        )

    def reset_pose(self, rng: RNGKey, q: jax.Array) -> jax.Array:
        """Returns the coordinates (nq,) with the target at random within reach."""
        share, turn = jax.random.uniform(rng, (2,), self.dtype)
        angle = np.asarray(2 * np.pi, self.dtype) * turn
        direction = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        distance = _FARTHEST * self._share_of_radius(share)
        return q.at[self._target].set(distance * direction)

    def _share_of_radius(self, share: jax.Array) -> jax.Array:
        """Returns the relative radius () of a target from a uniform number ()."""
        # as in the original, targets are denser near the shoulder
        return share

    @property
    def _target(self) -> np.ndarray:
        """Coordinates x and y of the target (2,)."""
        names = self.system.joint_names
        joints = np.array([names.index(name) for name in ("target_x", "target_y")])
        return self.system.q_start[joints].astype(np.int32)

    def observe(self, state: PhysicsState, action: Action) -> dict[str, jax.Array]:
        """Returns the blocks of the observation."""
        del action
        seen = physics.forward_kinematics(self.system, state.q, state.v)
        angles = state.q[self._joint_q]
        return {
            "cosines of the joint angles": jnp.cos(angles),
            "sines of the joint angles": jnp.sin(angles),
            "target position x y [m]": state.q[self._target],
            "tip velocity x y [m/s]": self._tip(seen)[1][:2],
            "tip minus target x y z [m]": self._miss(seen),
        }

    def _tip(self, seen: Kinematics) -> tuple[jax.Array, jax.Array]:
        """Returns position (3,) [m] and velocity (3,) [m/s] of the tip."""
        return point(seen, self.system.body_names.index("body1"), _TIP)

    def _miss(self, seen: Kinematics) -> jax.Array:
        """Returns the vector from the target to the tip (3,) [m]."""
        target = self.system.body_names.index("target")
        return self._tip(seen)[0] - seen.position[target]

    def _distance(self, state: PhysicsState) -> jax.Array:
        """Returns the distance () of the tip from the target [m]."""
        return length(
            self._miss(physics.forward_kinematics(self.system, state.q, state.v))
        )

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        del before
        distance, control = self._distance(after), ordered_sum(jnp.square(action))
        metrics = {"reward_dist": -distance, "reward_ctrl": -control}
        return -distance - control, jnp.zeros_like(distance), metrics


class ReacherAngle(Servos, Reacher):
    """The arm of the reacher, with actions that are target angles.

    An action from -1 to 1 is the target angle of a joint, from the lower to the upper
    end of its range. Other actions are clipped. Reward: minus the distance of the tip
    from the target. Never done.

    Metrics:
        rewardDist: Minus the distance of the tip from the target [m].
        rewardCtrl: 0, as in the original.
    """

    _spec = REACHERANGLE
    rollout_order = RolloutOrder.AT_ONCE  # the control depends on the action only

    def _share_of_radius(self, share: jax.Array) -> jax.Array:
        """Returns the relative radius () of a target, uniform over the disk."""
        return jnp.sqrt(share)

    def control(self, state: PhysicsState, action: Action) -> jax.Array:
        """Returns the target angles of the joints (nu,) [rad]."""
        del state
        return self.servo_targets(action)

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        del before, action
        distance = self._distance(after)
        zero = jnp.zeros_like(distance)
        return -distance, zero, {"rewardDist": -distance, "rewardCtrl": zero}
