"""Pushers: move an object over a table with the hand of an arm."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import physics
from newton_qd.envs.base import PhysicsEnv
from newton_qd.envs.options import checked_options
from newton_qd.envs.vectors import length, ordered_sum, rounded
from newton_qd.physics.system import PhysicsState
from newton_qd.robots import PUSHER, PUSHER_TABLE, RobotSpec
from newton_qd.types import Action, Metrics, RNGKey

# A reset draws the object's position from a rectangle, then limits its distance.
_LOWEST, _HIGHEST = (-0.3, -0.2), (0.0, 0.2)  # x and y [m]
_FARTHEST = 0.17  # from the origin [m]
_NEAR, _CONTROL = 0.5, 0.1  # weights of the hand's distance [1/m] and of control [-]


class Pusher(PhysicsEnv):
    """An arm with seven hinges that pushes an object over a table, driven by torques.

    Reward: minus the distance of the object from its goal, minus half of its distance
    from the hand, minus a cost of control. Both distances are those at the start of the
    step. Never done. There is no friction, so a pushed object keeps sliding.

    Metrics:
        reward_dist: Minus the distance of the object from its goal [m].
        reward_ctrl: Minus the sum of squared actions, without its weight of 0.1 [-].
        reward_near: Minus the distance of the object from the hand, without its weight
            of 0.5 [m].
    """

    _spec: RobotSpec = PUSHER
    reads_bodies = True

    @checked_options
    def __init__(
        self,
        *,
        reset_noise_scale: float = 0.0,
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
        """Returns the coordinates (nq,) with the object at random near the origin."""
        low, high = (jnp.asarray(ends, self.dtype) for ends in (_LOWEST, _HIGHEST))
        drawn = jax.random.uniform(rng, (2,), self.dtype, low, high)
        farthest = jnp.asarray(_FARTHEST, self.dtype)
        drawn_in = drawn * (farthest / jnp.maximum(length(drawn), farthest))
        names = self.system.joint_names
        joints = np.array([names.index(name) for name in ("object_x", "object_y")])
        return q.at[self.system.q_start[joints]].set(drawn_in)

    def observe(self, state: PhysicsState, action: Action) -> dict[str, jax.Array]:
        """Returns the blocks of the observation."""
        del action
        hand, pushed = self._places(state)
        return {
            "joint angles [rad]": state.q[self._joint_q],
            "joint velocities [rad/s]": state.v[self._joint_v],
            "hand position x y z [m]": hand,
            **self._aims(pushed),
        }

    def _places(self, state: PhysicsState) -> tuple[jax.Array, jax.Array]:
        """Returns the positions (3,) of the hand and of the object [m]."""
        position = physics.seen_bodies(self.system, state).position
        names = self.system.body_names
        hand, pushed = (
            position[names.index(name)] for name in ("r_wrist_roll_link", "object")
        )
        return hand, pushed

    def _goal(self) -> jax.Array:
        """Returns the goal of the object (3,) [m]."""
        system = self.system
        goal = system.scene_frames[system.scene_links.index("goal"), :3]
        return jnp.asarray(goal, self.dtype)

    def _aims(self, pushed: jax.Array) -> dict[str, jax.Array]:
        """Returns the blocks of the observation about object (3,) and goal."""
        return {
            "object position x y z [m]": pushed,
            "goal position x y z [m]": self._goal(),
        }

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        del after
        pushed = self._places(before)[1]
        distance = length(pushed - self._goal())
        cost, metrics = self._cost(before, action)
        metrics = {"reward_dist": -distance, **metrics}
        return -distance - cost, jnp.zeros_like(distance), metrics

    def _cost(self, before: PhysicsState, action: Action) -> tuple[jax.Array, Metrics]:
        """Returns the cost () of control and of a hand away from the object."""
        hand, pushed = self._places(before)
        near, control = length(pushed - hand), ordered_sum(jnp.square(action))
        cost = rounded(_CONTROL * control) + rounded(_NEAR * near)
        return cost, {"reward_ctrl": -control, "reward_near": -near}


class TablePusher(Pusher):
    """The arm of the pusher and an object that may end anywhere on the table.

    There is no goal. Reward: minus half of the distance of the object from the hand,
    minus a cost of control. So the hand should go to the object and stay with it, with
    little effort. Never done. The table has drag, 2 N at a speed of 1 m/s, so a pushed
    object stops. The object always starts at the same place. ``XYPositionWrapper``
    reads where it is.

    Metrics:
        reward_ctrl: Minus the sum of squared actions, without its weight of 0.1 [-].
        reward_near: Minus the distance of the object from the hand, without its weight
            of 0.5 [m].
    """

    _spec = PUSHER_TABLE

    @checked_options
    def __init__(
        self, *, reset_noise_scale: float = 0.005, dtype: str = "float32"
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
        super().__init__(
            reset_noise_scale=reset_noise_scale,
            reset_velocity_noise_scale=reset_noise_scale,
            dtype=dtype,
        )

    def reset_pose(self, rng: RNGKey, q: jax.Array) -> jax.Array:
        """Returns the default pose (nq,): the object always starts at one place."""
        del rng
        return q

    def _aims(self, pushed: jax.Array) -> dict[str, jax.Array]:
        """Returns the block of the observation about the object (3,)."""
        return {"object position x y [m]": pushed[:2]}

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        del after
        cost, metrics = self._cost(before, action)
        return -cost, jnp.zeros_like(cost), metrics
