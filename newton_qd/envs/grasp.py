"""Grasp: lift an object with a hand, and bring it to one target after another."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import physics
from newton_qd.envs.options import checked_options
from newton_qd.envs.servos import Servos
from newton_qd.envs.targets import GROUND, MovingTarget
from newton_qd.envs.vectors import length, ordered_sum, rounded
from newton_qd.physics.system import Kinematics, PhysicsState
from newton_qd.robots import GRASP
from newton_qd.types import Action, Metrics, RNGKey

_RADIUS = 1.1  # distance of the object from the target at which it is reached [m]
_SPREAD, _HEIGHT = 10.0, 8.0  # drawn radii go up to _RADIUS + _SPREAD, heights [m]
# Places of the palm that actions can ask for: x, y and z [m]
_LOWEST, _HIGHEST = (-10.0, -10.0, 3.5), (10.0, 10.0, 13.5)
_FARTHEST = 2.0  # longest way of the palm's target from the palm [m]
_MOVING, _CLOSE, _TOUCHING = 0.1, 0.1, 0.2  # weights of the rewards
_HIT, _CARRYING = 5.0, 1.5
_LEAST = 1e-6  # added to a distance that divides [m]
# As in the original. Of these, only the tip of a finger touches anything.
_TIPS = ("finger_1_distal", "finger_3_proximal", "finger_4_proximal", "target")
_HAND = "finger_1_proximal"  # its velocity is that of the hand, as in the original


def _finger(number: int, *parts: str) -> tuple[str, ...]:
    return tuple(f"finger_{number}_{part}" for part in parts)


class Grasp(Servos, MovingTarget):
    """A hand of four fingers that lifts an object and brings it to targets.

    An action from -1 to 1 is the target angle of a hinge of the fingers, from the lower
    to the upper end of its range. The last three actions are the target place of the
    palm: x and y from -10 to 10 m, z from 3.5 to 13.5 m. In each step, the palm goes
    15 % of the way to it, but never more than 0.3 m. Actions beyond -1 and 1 are
    clipped.

    Reward: 1.5 times the way of the object towards the target, and 5 when the object is
    within 1.1 m of the target. There are three small rewards: for a hand that moves to
    the object, for a palm above it, and for the tip of finger 1 that touches it. A
    target that was reached moves to a random place. The first target is next to the
    object, so the first step reaches it, as in the original. Never done.

    Metrics:
        hits: 1 if the target was reached, else 0.
        touchingObject: 0.004 if the tip of finger 1 touches the object, else 0.
        movingToObject: Reward of a hand that moves to the object: 0.1 per metre.
        movingObjectToTarget: Reward of the object's way to the target: 1.5 per metre.
        closeToObject: Reward of a palm above the object: at most 0.002.
    """

    _slides = ("target_x", "target_y", "target_z")
    _draws = 3
    _bodies = (
        GROUND,
        "object",
        *_finger(1, "proximal", "distal", "middle"),
        "palm",
        *(
            link
            for finger in (2, 3, 4)
            for link in _finger(finger, "proximal", "middle", "distal")
        ),
        "target",
    )

    @checked_options
    def __init__(
        self, *, reset_noise_scale: float = 0.0, dtype: str = "float32"
    ) -> None:
        """Loads the hand.

        Args:
            reset_noise_scale: Half width of the uniform noise on joint angles [rad]
                and joint velocities [rad/s] at a reset.
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.

        Raises:
            TypeError: An option has the wrong type.
            ValueError: An option has a value that is not allowed.
        """
        super().__init__(GRASP, reset_noise_scale=reset_noise_scale, dtype=dtype)

    def draw_target(self, *keys: RNGKey) -> jax.Array:
        """Returns x, y and z of the target (3,): uniform radius, angle and height."""
        shares = [jax.random.uniform(key, (), self.dtype) for key in keys]
        radius, spread, turn, height = np.array(
            [_RADIUS, _SPREAD, 2 * np.pi, _HEIGHT]
        ).astype(self.dtype)
        distance = radius + rounded(spread * shares[0])
        angle = turn * shares[1]
        return jnp.stack(
            [distance * jnp.cos(angle), distance * jnp.sin(angle), height * shares[2]]
        )

    def first_target(self, rng: RNGKey) -> tuple[RNGKey, jax.Array]:
        """Returns the key itself, and the place of the default pose (3,) [m]."""
        return rng, jnp.asarray(self.system.rest_q[self._target], self.dtype)

    def control(self, state: PhysicsState, action: Action) -> jax.Array:
        """Returns target angles (16,) [rad] and the target place of the palm (3,) [m].

        The result has shape (19,). The place is at most 2 m away from the palm.
        """
        targets = self.servo_targets(action)
        palm = state.q[self._palm]
        way = targets[-3:] - palm
        share = _FARTHEST / jnp.maximum(length(way), _FARTHEST)
        return targets.at[-3:].set(palm + rounded(share * way))

    @property
    def servo_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Targets (19,) of actions of -1, and of 1: limits of the hinges, and places.

        In rad, and in m for the palm.
        """
        low, high = super().servo_range
        return np.append(low[:-3], _LOWEST), np.append(high[:-3], _HIGHEST)

    @property
    def _palm(self) -> np.ndarray:
        """Coordinates of the palm (3,)."""
        names = self.system.joint_names
        joints = [names.index(f"palm_{axis}") for axis in "xyz"]
        return self.system.q_start[joints].astype(np.int32)

    def observe(self, state: PhysicsState, action: Action) -> dict[str, jax.Array]:
        """Returns the blocks of the observation."""
        del action
        seen = physics.seen_bodies(self.system, state)
        names = ", ".join(self._bodies)
        # the palm does not turn, so its axes are the world's
        local = self._rows(seen.com) - self._com(seen, "palm")[None]
        to_object, to_target, ahead = self._ways(seen)
        hand, carried = self._speed(seen, _HAND), self._speed(seen, "object")
        return {
            "object distance [m]": length(to_object)[None],
            "object direction": self._direction(to_object),
            "target distance [m]": length(to_target)[None],
            "target direction": self._direction(to_target),
            f"positions from the palm: {names} [m]": local.reshape(-1),
            f"velocities: {names} [m/s]": self._rows(seen.linear_velocity).reshape(-1),
            "object from the palm x y z [m]": to_object,
            f"{_HAND} velocity x y z [m/s]": hand,
            f"{_HAND} velocity towards the object [m/s]": self._along(hand, to_object),
            "target distance from the object [m]": length(ahead)[None],
            "target direction from the object": self._direction(ahead),
            "object velocity towards the target [m/s]": self._along(carried, ahead),
            f"contact, 0 or 1: {names}": self._contacts(state),
        }

    def _com(self, seen: Kinematics, link: str) -> jax.Array:
        """Returns the centre of mass (3,) of a link [m]."""
        return seen.com[self.system.body_names.index(link)]

    def _speed(self, seen: Kinematics, link: str) -> jax.Array:
        """Returns the velocity (3,) of the centre of mass of a link [m/s]."""
        return seen.linear_velocity[self.system.body_names.index(link)]

    def _ways(self, seen: Kinematics) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Returns the ways (3,) palm to object, palm to target, object to target."""
        palm, carried, target = (
            self._com(seen, link) for link in ("palm", "object", "target")
        )
        return carried - palm, target - palm, target - carried

    def _direction(self, way: jax.Array) -> jax.Array:
        """Returns the direction (3,) of a way (3,) [m]."""
        return way / (_LEAST + length(way))

    def _along(self, velocity: jax.Array, way: jax.Array) -> jax.Array:
        """Returns the component (1,) of a velocity (3,) along a way (3,) [m/s]."""
        return ordered_sum(velocity * self._direction(way))[None]

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        del before, action
        seen = physics.seen_bodies(self.system, after)
        to_object, _, ahead = self._ways(seen)
        going = self._along(self._speed(seen, _HAND), to_object)[0]
        carrying = self._along(self._speed(seen, "object"), ahead)[0]
        touches = self._contacts(after)[
            np.array([self._bodies.index(link) for link in _TIPS])
        ]
        moving, close, touching, far = np.array(
            [_MOVING, _CLOSE, _TOUCHING, _CARRYING]
        ).astype(self.dtype) * np.asarray(self.dt, self.dtype)
        hit = (length(ahead) < _RADIUS).astype(self.dtype)
        metrics = {
            "hits": hit,
            "touchingObject": rounded(touching * ordered_sum(touches)),
            "movingToObject": rounded(moving * going),
            "movingObjectToTarget": rounded(far * carrying),
            "closeToObject": close / (1 + length(to_object[:2])),
        }
        terms = ("movingToObject", "closeToObject", "touchingObject")
        reward = rounded(_HIT * hit) + metrics["movingObjectToTarget"]
        for term in terms:
            reward = reward + metrics[term]
        return reward, jnp.zeros_like(hit), metrics
