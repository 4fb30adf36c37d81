"""Fetch: run to one target after another."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd import physics
from newton_qd.envs.options import checked_options
from newton_qd.envs.targets import GROUND, Pursuit
from newton_qd.envs.vectors import ordered_sum, rounded
from newton_qd.physics.system import PhysicsState
from newton_qd.robots import FETCH
from newton_qd.types import Action, Metrics

_WEIGHT = 0.1  # of the torso's height [1/(m s)] and of its upright axis [1/s]
_LEGS = ("front_right", "front_left", "back_right", "back_left")


class Fetch(Pursuit):
    """A dog of boxes, driven by torques, that runs to one target after another.

    Reward: a tenth of the way of the torso towards the target, small rewards for a
    torso that is upright and high, and a reward within 2 m of the target: the cosine
    between the torso's x axis and the direction of the target. The target then moves to
    a random place. Never done. Only the lower legs touch the ground.

    Metrics:
        hits: 1 if the target was reached, else 0.
        weightedHits: The reward for it: 1 if the torso faces the target.
        movingToTarget: A tenth of the way towards the target [m].
        torsoIsUp: Reward of an upright torso: at most 0.002 [-].
        torsoHeight: Reward of the torso's height: 0.002 per metre.
    """

    _radius, _spread = 2.0, 15.0
    _bodies = (
        "torso",
        "shoulders",
        "hips",
        *(f"{leg}_{half}" for leg in _LEGS for half in ("upper", "lower")),
        GROUND,
        "target",
    )

    @checked_options
    def __init__(
        self, *, reset_noise_scale: float = 0.0, dtype: str = "float32"
    ) -> None:
        """Loads the dog.

        Args:
            reset_noise_scale: Half width of the uniform noise on joint angles [rad]
                and joint velocities [rad/s] at a reset.
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.

        Raises:
            TypeError: An option has the wrong type.
            ValueError: An option has a value that is not allowed.
        """
        super().__init__(FETCH, reset_noise_scale=reset_noise_scale, dtype=dtype)

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        _, done, found = super().outcome(before, after, action)
        seen = physics.seen_bodies(self.system, after)
        forward, _, up = self._axes(seen)
        _, aim = self._aim(seen)
        share = jnp.asarray(_WEIGHT * self.dt, self.dtype)
        metrics = {
            **found,
            "weightedHits": rounded(found["hits"] * ordered_sum(aim * forward)),
            "torsoIsUp": rounded(share * up[2]),
            "torsoHeight": rounded(share * seen.com[self.system.torso, 2]),
        }
        terms = ("torsoHeight", "movingToTarget", "torsoIsUp", "weightedHits")
        reward = metrics[terms[0]]
        for term in terms[1:]:
            reward = reward + metrics[term]
        return reward, done, metrics
