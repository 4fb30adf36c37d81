"""Shared code of the robots in a plane: observation blocks, and running upright.

Their root has the coordinates x, z and pitch. Its velocities are their rates.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.envs.base import PhysicsEnv
from newton_qd.envs.limits import survival, within
from newton_qd.envs.vectors import ordered_sum, rounded, wrapped
from newton_qd.physics.system import PhysicsState
from newton_qd.types import Action, Metrics

X, Z, PITCH = 0, 1, 2
_ROOT = 3  # coordinates of the root, and velocities


def blocks(
    state: PhysicsState, orientation: dict[str, jax.Array], *, omit_x: bool
) -> dict[str, jax.Array]:
    """Returns the blocks of the observation of a robot in a plane.

    Args:
        state: The state.
        orientation: The block of the torso's orientation.
        omit_x: Whether to omit the position along x.
    """
    q, v = state.q, state.v
    first = {} if omit_x else {"torso position x [m]": q[X : X + 1]}
    return {
        **first,
        "torso height [m]": q[Z : Z + 1],
        **orientation,
        "joint angles [rad]": q[_ROOT:],
        "torso velocity x z [m/s]": v[:PITCH],
        "torso angular velocity y [rad/s]": v[PITCH:_ROOT],
        "joint velocities [rad/s]": v[_ROOT:],
    }


def forward_velocity(before: PhysicsState, after: PhysicsState, dt: float) -> jax.Array:
    """Returns the mean velocity of the torso along x over a step () [m/s]."""
    return (after.q[X] - before.q[X]) / dt


def euler_pitch(angle: jax.Array) -> jax.Array:
    """Returns the Euler angle about y of a rotation by ``angle``, -pi/2 to pi/2 [rad].

    This is arcsin(sin(angle)), as in the original. It is computed by reflections, so
    its gradient is 1 or -1 everywhere.
    """
    half = np.asarray(np.pi, angle.dtype)
    angle = wrapped(angle)
    folded = jnp.where(angle > 0, half - angle, -half - angle)
    return jnp.where(jnp.abs(angle) > half / 2, folded, angle)


@dataclasses.dataclass(frozen=True)
class UprightRun:
    """Run along x without falling: reward and end of hopper and walker2d.

    Attributes:
        forward_reward_weight: Weight of the velocity along x [s/m].
        ctrl_cost_weight: Cost of the sum of squared actions [-].
        healthy_reward: Bonus per step [-].
        terminate_when_unhealthy: Whether an unhealthy torso ends the episode; if
            not, it only loses the bonus.
        healthy_z_range: Lowest and highest healthy height of the torso [m].
        healthy_angle_range: Lowest and highest healthy Euler pitch [rad].
    """

    forward_reward_weight: float
    ctrl_cost_weight: float
    healthy_reward: float
    terminate_when_unhealthy: bool
    healthy_z_range: tuple[float, float]
    healthy_angle_range: tuple[float, float]

    def outcome(
        self,
        before: PhysicsState,
        after: PhysicsState,
        action: Action,
        dt: float,
        width: float | None,
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step.

        Args:
            before: State at the start of the step.
            after: State at its end.
            action: (nu,) the action.
            dt: Duration of the step [s].
            width: Width of the gradient of done [m or rad]; ``None``: no gradient.
        """
        velocity = forward_velocity(before, after, dt)
        healthy = self._healthy(after, width)
        ends = self.terminate_when_unhealthy
        bonus, done = survival(healthy, self.healthy_reward, ends=ends)
        forward = rounded(self.forward_reward_weight * velocity)
        control = rounded(self.ctrl_cost_weight * ordered_sum(jnp.square(action)))
        metrics = {
            "reward_forward": forward,
            "reward_ctrl": -control,
            "reward_healthy": bonus,
            "x_position": after.q[X],
            "x_velocity": velocity,
        }
        return forward + bonus - control, done, metrics

    def _healthy(self, state: PhysicsState, width: float | None) -> jax.Array:
        """Returns 1 where height and pitch are in their ranges, else 0."""
        high_enough = within(state.q[Z], self.healthy_z_range, width)
        pitch = euler_pitch(state.q[PITCH])
        return high_enough * within(pitch, self.healthy_angle_range, width)


class UprightRunner(PhysicsEnv):
    """A robot with the task :class:`UprightRun`, which a subclass sets."""

    forward_reward_name = "reward_forward"
    _task: UprightRun
    _omit_x: bool  # whether the observation omits the position along x

    def observe(self, state: PhysicsState, action: Action) -> dict[str, jax.Array]:
        """Returns the blocks of the observation."""
        del action
        pitch = euler_pitch(state.q[PITCH])
        orientation = {"torso pitch [rad]": pitch[None]}
        return blocks(state, orientation, omit_x=self._omit_x)

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        return self._task.outcome(
            before, after, action, self.dt, self.termination_width
        )
