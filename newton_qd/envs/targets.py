"""Robots with a target that moves to a random place when it is reached."""

from __future__ import annotations

import abc
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import physics
from newton_qd.envs import inputs
from newton_qd.envs.base import PhysicsEnv
from newton_qd.envs.rollouts import RolloutOrder
from newton_qd.envs.state import State
from newton_qd.envs.vectors import length, ordered_sum, rotated, rounded
from newton_qd.physics.explicit_mesh import split_as
from newton_qd.physics.system import Kinematics, PhysicsState
from newton_qd.types import Action, Metrics, Params, RNGKey

GROUND = "ground"
"""Name, in a list of bodies, of the ground, which is at the origin."""
_LEAST = 1e-6  # added to a distance that divides [m]
_CONTACT = 1e-5  # squared velocity change of a body that counts as contact [m^2/s^2]
# Random bit generators by the length of the data of a key.
_GENERATORS = {2: "threefry2x32", 4: "rbg"}


class MovingTarget(PhysicsEnv):
    """A robot with a target that moves to a random place when the robot reaches it.

    The target is a link of the URDF file that slides along x and y, or along x, y and
    z, from the world's origin. Its joints are called ``target_x`` and so on. It is part
    of the physics state, and nothing else moves it.

    ``info["rng"]`` is the data of the key from which the next place is drawn. Each step
    replaces it, so ``step`` is a pure function, and worlds with keys of their own have
    targets of their own. The place has no gradient.

    A subclass has a metric ``hits``, which is 1 in a step that reaches the target. The
    observation and the reward of this step are those of the old place, as in the
    original.
    """

    rollout_order = RolloutOrder.ONE_BY_ONE
    reads_bodies = True
    _slides: tuple[str, ...] = ("target_x", "target_y")
    _draws = 2  # keys that ``draw_target`` takes
    _bodies: tuple[str, ...]  # bodies that a subclass observes, in order

    @abc.abstractmethod
    def draw_target(self, *keys: RNGKey) -> jax.Array:
        """Returns a random place of the target.

        Args:
            *keys: Keys, as many as the subclass says.

        Returns:
            Coordinates (n,) of the target's slides [m].
        """

    def first_target(self, rng: RNGKey) -> tuple[RNGKey, jax.Array]:
        """Returns the key of the first step, and the place (n,) of a reset [m].

        Args:
            rng: The key of the reset.
        """
        return self._next(rng)

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode with the target in a random place.

        Raises:
            TypeError: ``rng`` is not a key.
            ValueError: ``rng`` is several keys, or the environment is float64 and JAX
                x64 is off.
        """
        inputs.require_key("rng", rng)
        # the noise on the joints has a key of its own; the others are the original's
        state = super().reset(jax.random.fold_in(rng, 1))
        key, place = self.first_target(rng)
        state = self._placed(state, key, place)
        action = jnp.zeros((self.action_size,), self.dtype)
        obs = self._observation(state.pipeline_state, action)
        return split_as([rng], state.replace(obs=obs))

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances by one control step, then moves a target that was reached.

        Raises:
            TypeError: The state or the action has the wrong type.
            ValueError: The state, the action or ``params`` do not fit this robot, or
                the environment is float64 and JAX x64 is off.
        """
        inputs.require_state(state, "rng")
        data = state.info["rng"]
        after = super().step(state, action, params)
        generator = _GENERATORS[data.shape[-1]]
        key, place = self._next(jax.random.wrap_key_data(data, impl=generator))
        old = after.pipeline_state.q[self._target]
        place = jnp.where(after.metrics["hits"] > 0, place, old)
        return self._placed(after, key, place)

    def _next(self, rng: RNGKey) -> tuple[RNGKey, jax.Array]:
        """Returns the next key, and a place of the target (n,) [m]."""
        following, *draws = jax.random.split(rng, 1 + self._draws)
        return following, self.draw_target(*draws)

    def _placed(self, state: State, key: RNGKey, place: jax.Array) -> State:
        """Returns a state with the target at a place (n,) [m], and with another key."""
        if jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
            key = jax.random.key_data(key)
        physical: PhysicsState = state.pipeline_state
        bodies = physics.seen_bodies(self.system, physical)
        position, com = bodies.position, bodies.com
        for count, body in enumerate(self._links, 1):
            position = position.at[body, :count].set(place[:count])
            com = com.at[body, :count].set(place[:count])
        moved = dataclasses.replace(
            physical,
            q=physical.q.at[self._target].set(place),
            bodies=dataclasses.replace(bodies, position=position, com=com),
        )
        info = {**state.info, "rng": key}
        return state.replace(pipeline_state=moved, info=info)

    def _first_state(self, state: PhysicsState) -> State:
        """Returns the first state of an episode, with the key of a fixed reset."""
        first = super()._first_state(state)
        key = jax.random.key_data(jax.random.key(0))
        return first.replace(info={**first.info, "rng": key})

    def _rows(self, values: jax.Array) -> jax.Array:
        """Returns rows (n, 3) of the observed bodies of rows (nb, 3) of all bodies."""
        known = (*self.system.body_names, GROUND)
        rows = np.array([known.index(name) for name in self._bodies], np.int32)
        still = split_as([values], jnp.zeros((1, 3), values.dtype))
        return jnp.concatenate([values, still])[rows]

    def _contacts(self, state: PhysicsState) -> jax.Array:
        """Returns 1 for each observed body (n,) that contact made faster, else 0."""
        masses = dict(zip(self.system.body_names, self.system.mass, strict=True))
        mass = np.array([masses.get(name, 1.0) for name in self._bodies], self.dtype)
        change = self._rows(state.impulse[:, :3]) / mass[:, None]
        return (ordered_sum(jnp.square(change).T) > _CONTACT).astype(self.dtype)

    @property
    def _links(self) -> tuple[int, ...]:
        """Body of each slide of the target."""
        return tuple(self.system.joint_names.index(name) for name in self._slides)

    @property
    def _target(self) -> np.ndarray:
        """Coordinates of the target (n,)."""
        return self.system.q_start[list(self._links)].astype(np.int32)


class Pursuit(MovingTarget):
    """A robot whose torso goes to targets around the origin, which it sees from itself.

    A subclass names the bodies that it observes, in order, and how near and how far
    targets are.
    """

    _radius: float  # distance of the torso from the target at which it is reached [m]
    _spread: float  # drawn radii of the target: from the above to this much more [m]

    def draw_target(self, *keys: RNGKey) -> jax.Array:
        """Returns x and y of the target (2,), uniform in its radius and its angle."""
        shares = [jax.random.uniform(key, (), self.dtype) for key in keys]
        radius, spread, turn = np.array([self._radius, self._spread, 2 * np.pi]).astype(
            self.dtype
        )
        distance = radius + rounded(spread * shares[0])
        angle = turn * shares[1]
        return jnp.stack([distance * jnp.cos(angle), distance * jnp.sin(angle)])

    def observe(self, state: PhysicsState, action: Action) -> dict[str, jax.Array]:
        """Returns the blocks of the observation."""
        del action
        seen = physics.seen_bodies(self.system, state)
        torso, names = self.robot.torso, ", ".join(self._bodies)
        away = self._rows(seen.com) - seen.com[self.system.torso][None]
        local = self._in_torso(seen, away)
        distance, _ = self._aim(seen)
        aim = local[self._bodies.index("target")] / (_LEAST + distance)
        velocity = self._in_torso(seen, self._rows(seen.linear_velocity))
        x, _, z = self._axes(seen)
        return {
            f"{torso}, direction of its x axis": x,
            f"{torso}, direction of its z axis": z,
            "target distance [m]": distance[None],
            f"target direction, in axes of {torso}": aim,
            f"positions from {torso}, in its axes: {names} [m]": local.reshape(-1),
            f"velocities in axes of {torso}: {names} [m/s]": velocity.reshape(-1),
            f"contact, 0 or 1: {names}": self._contacts(state),
        }

    def _axes(self, seen: Kinematics) -> jax.Array:
        """Returns the axes of the torso (3, 3), a row each, in world axes."""
        turn = jnp.tile(seen.rotation[self.system.torso], (3, 1))
        return rotated(turn, split_as([turn], jnp.eye(3, dtype=turn.dtype)))

    def _in_torso(self, seen: Kinematics, vectors: jax.Array) -> jax.Array:
        """Returns vectors (n, 3) in axes of the torso."""
        back = seen.rotation[self.system.torso] * np.array([-1, -1, -1, 1], self.dtype)
        return rotated(jnp.tile(back, (len(vectors), 1)), vectors)

    def _aim(self, seen: Kinematics) -> tuple[jax.Array, jax.Array]:
        """Returns distance () [m] and direction (3,) of the target from the torso."""
        target = self.system.body_names.index("target")
        away = seen.com[target] - seen.com[self.system.torso]
        distance = length(away)
        return distance, away / (_LEAST + distance)

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        del action
        start, end = (physics.seen_bodies(self.system, s) for s in (before, after))
        distance, aim = self._aim(end)
        way = end.com[self.system.torso] - start.com[self.system.torso]
        moving = rounded(0.1 * ordered_sum(way * aim))
        hit = (distance < self._radius).astype(self.dtype)
        metrics = {"hits": hit, "weightedHits": hit, "movingToTarget": moving}
        return moving + hit, jnp.zeros_like(hit), metrics
