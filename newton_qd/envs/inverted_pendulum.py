"""Inverted pendulums: keep one pole, or two, upright on a cart."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from newton_qd import physics
from newton_qd.envs.base import PhysicsEnv
from newton_qd.envs.limits import within
from newton_qd.envs.options import checked_options
from newton_qd.envs.points import point
from newton_qd.envs.vectors import ordered_sum, wrapped
from newton_qd.physics.system import PhysicsState
from newton_qd.robots import INVERTED_DOUBLE_PENDULUM, INVERTED_PENDULUM
from newton_qd.types import Action, Metrics

_TIP = (0.0, 0.0, 0.6)  # end of the upper pole's axis, in its link [m]
# Penalties of the squared distances of the tip from x = 0 and from a height of 2 m
# [1/m^2], and of the squared joint velocities [s^2/rad^2].
_WEIGHTS = (0.01, 1.0, 1e-3, 5e-3)


class InvertedPendulum(PhysicsEnv):
    """A pole on a cart. The action pushes the cart along x. Each step is rewarded.

    Reward: 1. Done when the pole leans more than 0.2 rad.
    """

    @checked_options
    def __init__(
        self, *, reset_noise_scale: float = 0.01, dtype: str = "float32"
    ) -> None:
        """Loads the pendulum.

        Args:
            reset_noise_scale: Half width of the uniform noise on the pole's angle
                [rad] and angular velocity [rad/s] at a reset.
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.

        Raises:
            TypeError: An option has the wrong type.
            ValueError: An option has a value that is not allowed.
        """
        super().__init__(
            INVERTED_PENDULUM, reset_noise_scale=reset_noise_scale, dtype=dtype
        )

    def observe(self, state: PhysicsState, action: Action) -> dict[str, jax.Array]:
        """Returns the blocks of the observation."""
        del action
        q, v = state.q, state.v
        return {
            "cart position x [m]": q[:1],
            "pole angle [rad]": wrapped(q[1:]),
            "cart velocity x [m/s]": v[:1],
            "pole angular velocity [rad/s]": v[1:],
        }

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        del before, action
        done = 1 - within(wrapped(after.q[1]), (-0.2, 0.2), self.termination_width)
        return jnp.ones_like(done), done, {}


class InvertedDoublePendulum(PhysicsEnv):
    """Two poles, one on the other, on a cart. The action pushes the cart along x.

    Reward: 10, minus penalties for the position of the upper pole's tip and for the
    joint velocities. Done when the tip is at a height of 1 m or less. Its height is 1.3
    m when the poles are upright.
    """

    @checked_options
    def __init__(
        self, *, reset_noise_scale: float = 0.01, dtype: str = "float32"
    ) -> None:
        """Loads the pendulum.

        Args:
            reset_noise_scale: Half width of the uniform noise on the poles' angles
                [rad] and angular velocities [rad/s] at a reset.
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.

        Raises:
            TypeError: An option has the wrong type.
            ValueError: An option has a value that is not allowed.
        """
        super().__init__(
            INVERTED_DOUBLE_PENDULUM, reset_noise_scale=reset_noise_scale, dtype=dtype
        )

    def observe(self, state: PhysicsState, action: Action) -> dict[str, jax.Array]:
        """Returns the blocks of the observation."""
        del action
        q, v = state.q, state.v
        return {
            "cart position x [m]": q[:1],
            "sines of the joint angles": jnp.sin(q[1:]),
            "cosines of the joint angles": jnp.cos(q[1:]),
            "cart velocity x [m/s]": v[:1],
            "joint velocities [rad/s]": v[1:],
        }

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        del before, action
        seen = physics.forward_kinematics(self.system, after.q, after.v)
        x, _, height = point(seen, self.system.body_names.index("pole2"), _TIP)[0]
        off = jnp.stack([x, height - 2, after.v[1], after.v[2]])
        penalty = ordered_sum(jnp.asarray(_WEIGHTS, self.dtype) * jnp.square(off))
        done = within(height, (-math.inf, 1.0), self.termination_width)
        return 10 - penalty, done, {}
