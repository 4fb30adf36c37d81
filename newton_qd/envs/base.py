"""What an environment is, and the part that all simulated robots share."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from newton_qd import physics
from newton_qd.envs.vectors import ordered_sum as ordered_sum
from newton_qd.errors import FaultError
from newton_qd.physics.system import PhysicsState, System
from newton_qd.robots import Robot
from newton_qd.types import Action, Info, Metrics, Observation, Params, RNGKey

Tree = TypeVar("Tree")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class State:
    """What ``reset`` and ``step`` return; a pytree that never changes its shape.

    Every leaf of a batched state has the batch axis in front.

    Attributes:
        pipeline_state: What the simulation needs to go on: a ``PhysicsState``.
        obs: (no,) observation.
        reward: () reward of the step that led here; 0 after a reset.
        done: () 1 where the episode has ended, else 0.
        metrics: Parts of the reward and other () readings, 0 after a reset.
        info: What wrappers remember; ``newton_qd.types.INFO_KEYS`` lists the keys.
    """

    pipeline_state: Any
    obs: Observation
    reward: jax.Array
    done: jax.Array
    metrics: Metrics
    info: Info

    def replace(self, **changes: Any) -> State:
        """Returns a copy with some fields replaced."""
        return dataclasses.replace(self, **changes)


class Env(abc.ABC):
    """An environment: two pure functions and their sizes.

    Environments are immutable, compare and hash by identity, and may be static
    arguments of jitted functions.
    """

    @abc.abstractmethod
    def reset(self, rng: RNGKey) -> State:
        """Begins an episode.

        Args:
            rng: One key, ``jax.random.key(0)`` or ``jax.random.PRNGKey(0)``.
        """

    @abc.abstractmethod
    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances by one control step of ``dt``.

        Args:
            state: Where to start; it is not changed and may be stepped again.
            action: (nu,) array of the environment's dtype, meant for -1 to 1.
            params: Physical parameters of the world; ``None``: as in its files.
        """

    @property
    @abc.abstractmethod
    def observation_size(self) -> int:
        """Length of an observation."""

    @property
    @abc.abstractmethod
    def action_size(self) -> int:
        """Length of an action."""

    @property
    @abc.abstractmethod
    def dtype(self) -> np.dtype:
        """Type of every floating-point array of a state, and of the actions."""

    @property
    @abc.abstractmethod
    def dt(self) -> float:
        """Duration of a step [s]."""

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """Name of the robot or of the task."""

    @property
    def unwrapped(self) -> Env:
        """The environment inside all wrappers."""
        return self


class QDEnv(Env):
    """An environment that writes ``info["state_descriptor"]``.

    The descriptor of an episode has the length and limits of the state descriptor,
    under both names that QDax has used for them.
    """

    @property
    @abc.abstractmethod
    def state_descriptor_length(self) -> int:
        """Length of a state descriptor."""

    @property
    @abc.abstractmethod
    def state_descriptor_name(self) -> str:
        """What a state descriptor measures."""

    @property
    @abc.abstractmethod
    def state_descriptor_limits(self) -> tuple[jax.Array, jax.Array]:
        """Lower and upper limits, (nd,) each."""

    @property
    def descriptor_length(self) -> int:
        """Length of an episode's descriptor."""
        return self.state_descriptor_length

    @property
    def descriptor_limits(self) -> tuple[jax.Array, jax.Array]:
        """Lower and upper limits of an episode's descriptor, (nd,) each."""
        return self.state_descriptor_limits

    behavior_descriptor_length = descriptor_length
    behavior_descriptor_limits = descriptor_limits


class PhysicsEnv(Env):
    """A simulated robot: reset noise, checks of the input, containment of faults.

    A subclass gives the observation and the outcome of a step. A world that meets
    a value that is not finite is frozen where it was: ``info["fault"]`` becomes 1
    and stays until a reset, reward and metrics are 0, done is 1, and no gradient
    passes. Other worlds do not notice.
    """

    _vertical = 2  # coordinate that raises the robot: z of a free root

    def __init__(
        self, robot: Robot, *, reset_noise_scale: float, dtype: str = "float32"
    ) -> None:
        """Loads the robot.

        Args:
            robot: Row of the robot.
            reset_noise_scale: Half width of the uniform noise on joint angles [rad]
                and joint velocities [rad/s] at a reset.
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.
        """
        self.system: System = physics.load_system(robot, dtype)
        self.robot = robot
        self._dtype = np.dtype(dtype)
        self._noise_scale = reset_noise_scale
        system = self.system
        joints = np.flatnonzero(np.isin(system.v_start, system.control_dof))
        self._joint_q = system.q_start[joints].astype(np.int32)
        self._joint_v = system.v_start[joints].astype(np.int32)
        rest = jax.eval_shape(self._rest)
        action = jax.ShapeDtypeStruct((system.nu,), self._dtype)
        self._layout: tuple[tuple[str, int], ...] = ()
        jax.eval_shape(self._record_layout, rest, action)
        self._metrics = tuple(jax.eval_shape(self._outcome, rest, rest, action)[2])

    @abc.abstractmethod
    def _observe(self, state: PhysicsState, action: Action) -> dict[str, jax.Array]:
        """Returns the named blocks (n,) of the observation, in order.

        The action is the one that led to the state; zero after a reset.
        """

    @abc.abstractmethod
    def _outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward (), done () and metrics () of a step."""

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode in the default pose with noise on the joints."""
        self._require_precision()
        _, angle_key, velocity_key = jax.random.split(rng, 3)
        rest = self._rest()
        q = rest.q.at[self._joint_q].add(self._noise(angle_key))
        if self.robot.rest_height is None:
            height = physics.lowest_contact(self.system, q)
            q = q.at[self._vertical].add(-height)
        v = rest.v.at[self._joint_v].set(self._noise(velocity_key))
        return self._first_state(physics.initial_state(self.system, q, v))

    def fixed_state(self) -> State:
        """Returns the state of a reset without noise: the default pose, at rest."""
        self._require_precision()
        return self._first_state(self._rest())

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances by one control step, or freezes a world at fault."""
        self._require_precision()
        if params is not None:
            raise ValueError(
                f"params={params!r}: per-world parameters are not available yet; "
                "allowed: None"
            )
        action = self._checked_action(action)
        # The physics freezes a world at fault and passes no gradient through it; a
        # world that was at fault before is handed over as one. The outcome sees zeros
        # instead, so that its zero gradient is not 0 * nan (double where).
        start: PhysicsState = state.pipeline_state
        sound = _all_finite(action) & (state.info["fault"] == 0)
        nan = jnp.full_like(action, jnp.nan)
        after, fault = physics.step(self.system, start, jnp.where(sound, action, nan))
        fault = jnp.maximum(state.info["fault"], fault)
        faulty = fault != 0
        action = jnp.where(faulty, jnp.zeros_like(action), action)
        reward, done, metrics = self._outcome(start, after, action)
        reward, metrics = select(
            faulty, jax.tree.map(jnp.zeros_like, (reward, metrics)), (reward, metrics)
        )
        return state.replace(
            pipeline_state=after,
            obs=self._observation(after, action),
            reward=reward,
            done=jnp.where(faulty, jnp.ones_like(done), done),
            metrics={**state.metrics, **metrics},
            info={**state.info, "fault": fault},
        )

    @property
    def observation_layout(self) -> tuple[tuple[str, int], ...]:
        """Name and size of each block of the observation, in order."""
        return self._layout

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return sum(size for _, size in self._layout)

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return self.system.nu

    @property
    def dtype(self) -> np.dtype:
        """Type of every floating-point array of a state, and of the actions."""
        return self._dtype

    @property
    def dt(self) -> float:
        """Duration of a step [s]."""
        return self.robot.dt

    @property
    def name(self) -> str:
        """Name of the robot."""
        return self.robot.name

    def _rest(self) -> PhysicsState:
        """Returns the default pose, at rest."""
        q = jnp.asarray(self.system.rest_q, self._dtype)
        v = jnp.zeros((self.system.nv,), self._dtype)
        return physics.initial_state(self.system, q, v)

    def _record_layout(self, state: PhysicsState, action: Action) -> None:
        # not a result of eval_shape: it would sort the names
        blocks = self._observe(state, action).items()
        self._layout = tuple((name, block.shape[0]) for name, block in blocks)

    def _noise(self, rng: RNGKey) -> jax.Array:
        shape, scale = self._joint_q.shape, self._noise_scale
        return jax.random.uniform(rng, shape, self._dtype, -scale, scale)

    def _observation(self, state: PhysicsState, action: Action) -> Observation:
        return jnp.concatenate(list(self._observe(state, action).values()))

    def _first_state(self, state: PhysicsState) -> State:
        action = jnp.zeros((self.action_size,), self._dtype)
        return State(
            pipeline_state=state,
            obs=self._observation(state, action),
            reward=jnp.zeros((), self._dtype),
            done=jnp.zeros((), self._dtype),
            metrics={name: jnp.zeros((), self._dtype) for name in self._metrics},
            info={"fault": jnp.zeros((), jnp.int32)},
        )

    def _require_precision(self) -> None:
        # JAX would otherwise round every array to float32 without an error.
        if self._dtype == np.float64 and not jax.config.read("jax_enable_x64"):
            raise ValueError(
                "dtype='float64': JAX x64 is off; allowed: 'float32', or "
                "jax.config.update('jax_enable_x64', True) before the environment"
            )

    def _checked_action(self, action: Action) -> Action:
        """Returns the action, strongly typed, or raises what is wrong with it."""
        expected = f"allowed: an array of shape {(self.action_size,)}, {self._dtype}"
        if not isinstance(action, (jax.Array, np.ndarray)):
            raise TypeError(f"action: type {type(action).__name__} given; {expected}")
        values = jnp.asarray(action)
        weak = jnp.issubdtype(values.dtype, jnp.floating) and values.weak_type
        if values.dtype != self._dtype and not weak:
            raise TypeError(f"action: dtype {values.dtype} given; {expected}")
        if values.shape != (self.action_size,):
            raise ValueError(
                f"action: shape {values.shape} given; {expected} (for a batch, use "
                "jax.vmap or create(..., batch_size=...))"
            )
        return values.astype(self._dtype)


def select(condition: jax.Array, chosen: Tree, other: Tree) -> Tree:
    """Chooses between two pytrees, world by world.

    Args:
        condition: Booleans; the leading axes of every leaf.
        chosen: Where ``condition`` is true.
        other: Elsewhere.
    """

    def leaf(a: jax.Array, b: jax.Array) -> jax.Array:
        axes = condition.shape + (1,) * (jnp.ndim(b) - condition.ndim)
        return jnp.where(condition.reshape(axes), a, b)

    return jax.tree.map(leaf, chosen, other)


def check(state: State) -> None:
    """Raises where a world is at fault; for eager code, after a jitted rollout.

    Args:
        state: State of one world or of any batch.

    Raises:
        FaultError: Names the worlds, and their steps where ``info`` has them.
        TypeError: ``state`` is traced.
    """
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(state)):
        raise TypeError(
            "state: traced values given; allowed: the concrete state that a jitted "
            "function has returned (inside jit, read info['fault'])"
        )
    info: Mapping[str, Any] = state.info
    faulty = np.asarray(info["fault"]) != 0
    for leaf in jax.tree.leaves((state.pipeline_state, state.obs, state.reward)):
        finite = np.isfinite(np.asarray(leaf)).reshape((*faulty.shape, -1))
        faulty = faulty | ~finite.all(axis=-1)
    worlds = [tuple(int(i) for i in world) for world in np.argwhere(faulty)]
    if not worlds:
        return
    steps = np.asarray(info["steps"]) if "steps" in info else None
    named = []
    for world in worlds[:8]:
        index = world[0] if len(world) == 1 else world
        at = "" if steps is None else f" at step {int(steps[world])}"
        named.append(f"world {index}{at}" if world else f"the world{at}")
    more = f" and {len(worlds) - 8} more" if len(worlds) > 8 else ""
    raise FaultError(
        f"not finite: {', '.join(named)}{more}; frozen there with reward 0 and done 1 "
        "(a non-finite action or state, or a step that diverged)"
    )


def _all_finite(values: jax.Array) -> jax.Array:
    return jnp.all(jnp.isfinite(values))
