"""Locomotion of any robot with a free root: a start for your own tasks."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd.checks import Fact, message
from newton_qd.envs.base import PhysicsEnv
from newton_qd.envs.limits import within
from newton_qd.envs.options import checked_options
from newton_qd.envs.vectors import ordered_sum, rounded
from newton_qd.physics.system import JointKind, PhysicsState
from newton_qd.robots import RobotSpec
from newton_qd.scenes import Scene
from newton_qd.types import Action, Metrics

_ROOT_Q, _ROOT_V = 7, 6  # a free root has 7 coordinates and 6 velocities


class Locomotion(PhysicsEnv):
    """Any robot with a free root, rewarded for velocity along x.

    Reward: weighted velocity of the root along x, plus a bonus for being healthy, minus
    a cost of control. Done when the height of the root is not healthy. For other
    rewards, override ``outcome`` in a subclass.

    Where the robot has other free bodies, such as a ball, their coordinates are among
    those of the joints in the observation.
    """

    forward_reward_name = "reward_forward"

    @checked_options
    def __init__(
        self,
        robot: RobotSpec,
        *,
        forward_reward_weight: float = 1.0,
        ctrl_cost_weight: float = 0.5,
        healthy_reward: float = 1.0,
        healthy_z_range: tuple[float, float] = (0.0, float("inf")),
        reset_noise_scale: float = 0.1,
        dtype: str = "float32",
        scene: Scene | None = None,
    ) -> None:
        """Loads a robot.

        Args:
            robot: Spec of the robot; the root of its torso moves freely.
            forward_reward_weight: Weight of the velocity along x [s/m].
            ctrl_cost_weight: Cost of the sum of squared actions [-].
            healthy_reward: Bonus per step [-].
            healthy_z_range: Lowest and highest healthy height of the root [m].
            reset_noise_scale: Half width of the uniform noise on joint angles [rad]
                and joint velocities [rad/s] at a reset.
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.
            scene: Obstacles on the ground; ``None``: no obstacles.

        Raises:
            ValueError: The torso has no free root, or the range is empty.
        """
        self._forward_reward_weight = forward_reward_weight
        self._ctrl_cost_weight = ctrl_cost_weight
        self._healthy_reward = healthy_reward
        self._healthy_z_range = healthy_z_range
        super().__init__(
            robot, reset_noise_scale=reset_noise_scale, dtype=dtype, scene=scene
        )
        if self.system.free_root is None:
            root = self.system.roots[self.system.torso]
            kind = JointKind(self.system.joint_kind[root])
            why = f"whose first joint is {kind.name.lower()}"
            allowed = "a robot whose root link moves freely"
            raise ValueError(message("robot", Fact(robot.name), allowed, why=why))

    def observe(self, state: PhysicsState, action: Action) -> dict[str, jax.Array]:
        """Returns the blocks of the observation."""
        del action
        (root, q), (root_v, v) = self._split(state.q), self._split(state.v)
        return {
            "root height [m]": root[2:3],
            "root orientation w x y z": jnp.concatenate([root[6:7], root[3:6]]),
            "joint angles [rad]": q,
            "root velocity x y z [m/s]": root_v[:3],
            "root angular velocity x y z [rad/s]": root_v[3:],
            "joint velocities [rad/s]": v,
        }

    def _split(self, values: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns the numbers of the root, of (nq,) or (nv,), and all others."""
        system = self.system
        starts, size = (
            (system.q_start, _ROOT_Q)
            if values.size == system.nq
            else (system.v_start, _ROOT_V)
        )
        # the constructor checks that there is a root, after its first observation
        start = int(starts[system.free_root or 0])
        root = values[start : start + size]
        if start == 0:
            return root, values[size:]
        return root, jnp.concatenate([values[:start], values[start + size :]])

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        start, end = (self._split(s.q)[0] for s in (before, after))
        x_velocity = (end[0] - start[0]) / self.dt
        healthy = within(end[2], self._healthy_z_range, self.termination_width)
        forward = rounded(self._forward_reward_weight * x_velocity)
        bonus = jnp.full_like(forward, self._healthy_reward)
        control = rounded(self._ctrl_cost_weight * ordered_sum(jnp.square(action)))
        metrics = {
            "reward_forward": forward,
            "reward_survive": bonus,
            "reward_ctrl": -control,
            "x_position": end[0],
            "y_position": end[1],
            "x_velocity": x_velocity,
        }
        return forward + bonus - control, 1 - healthy, metrics
